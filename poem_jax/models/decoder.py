"""Decoders: query points read what basis points carry, and move.

`Decoder` moves all 799: paper, section "Point-Embedded Transformer Decoder". The layer of the paper and that
of the release are two classes with one signature. Coordinates are in units of the basis radius, about the
root. `JointDecoder` is ours and moves the 21 joints beforehand, by basis points of their own, in metres.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.sampling import sample_bilinear
from poem_jax.geometry.transforms import matmul, rotate_points, transpose
from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES, ROOT_JOINT
from poem_jax.models.config import DecoderConfig, DecoderOutput, Design, JointDecoderConfig, NeighbourSearch
from poem_jax.models.hand_output import palm_frame
from poem_jax.models.layers import DecoderRow, Exact, PerQuery, dropout, layer_norm, linear, normal
from poem_jax.models.point_features import projected_features
from poem_jax.models.vector_attention import (
    BracketedVectorAttention,
    Neighbours,
    VectorAttention,
    nearest_neighbours,
)
from poem_jax.typing import Array, Bool, Float, PRNGKeyArray

PAPER_EPSILON, RELEASE_EPSILON = 1e-5, 1e-12
"""Of the layer norms."""
_OFFSET_M = 0.01
"""The joint decoder regresses offsets in centimetres."""
_EMBEDDING_SCALE = 0.3
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
_AXES = np.concatenate([np.eye(3), -np.eye(3)])


class Surroundings(NamedTuple):
    """The neighbours of every query point."""

    basis: Neighbours
    queries: Neighbours | None
    """None where queries do not read each other."""


def shared(surroundings: Surroundings, batch_size: int) -> Surroundings:
    """Give the surroundings of one sample to a whole batch."""

    def spread(near: Neighbours) -> Neighbours:
        k, _, query = near.index.shape
        return near._replace(index=jnp.broadcast_to(near.index, (k, batch_size, query)))

    basis, queries = surroundings
    return Surroundings(spread(basis), None if queries is None else spread(queries))


class Decoder(DecoderRow):
    """Learned query embeddings and a row of layers that each move the query points."""

    def __init__(self, config: DecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.config = config
        self.embeddings = PerQuery(normal(rngs.params(), (NUM_QUERIES, width)))
        layer = ReleaseLayer if config.layer is Design.RELEASE else PaperLayer
        self.layers = nnx.List(
            layer(config, width, is_last=i == config.num_layers - 1, rngs=rngs)
            for i in range(config.num_layers)
        )
        self.locate = CoordinateEmbedding(width, rngs=rngs) if config.embed_coordinates else None

    def __call__(
        self,
        queries: Float[Array, "batch query 3"],
        points: Float[Array, "basis 3"],
        features: Float[Array, "batch basis c"],
        first: Surroundings | None = None,
        dropout_key: PRNGKeyArray | None = None,
    ) -> tuple[list[Float[Array, "batch query 3"]], Float[Array, "batch query c"]]:
        """Return the query points after every layer that moves them, and the last embeddings.

        `first`: whom the first layer reads, the same in all samples (batch 1); None = the nearest, as in the
        other layers.
        """
        embeddings = jnp.broadcast_to(self.embeddings[...], (*queries.shape[:-1], features.shape[-1]))
        if self.locate is not None:
            features = features + self.locate(points)
        surroundings = self._surroundings(queries, points) if first is None else shared(first, len(queries))
        moved = []
        for i, layer in enumerate(self.layers):
            if moved and self.config.neighbour_search is NeighbourSearch.EVERY_LAYER:
                surroundings = self._surroundings(queries, points)
            if self.locate is not None:
                embeddings = embeddings + self.locate(queries)
            key = None if dropout_key is None else jax.random.fold_in(dropout_key, i)
            embeddings, queries = self.run(layer, embeddings, queries, features, surroundings, key)
            moved.append(queries)
        return moved[: len(moved) - (self.config.output is DecoderOutput.HAND_PARAMETERS)], embeddings

    def _surroundings(self, queries: Array, points: Array) -> Surroundings:
        k = self.config.num_neighbours
        shared = jnp.broadcast_to(points, (queries.shape[0], *points.shape))
        among = self.config.layer is Design.RELEASE
        return Surroundings(
            nearest_neighbours(queries, shared, k),
            nearest_neighbours(queries, queries, k) if among else None,
        )


class PaperLayer(nnx.Module):
    """Queries read each other, the basis points, and their nearest basis points; then they move."""

    def __init__(self, config: DecoderConfig, width: int, *, is_last: bool, rngs: nnx.Rngs) -> None:
        self.basis_stride = config.cross_attention_basis_stride
        self.self_attention, self.cross_attention = _scalar_attentions(config, width, rngs)
        self.vector_attention = VectorAttention(width, rngs=rngs)
        self.norms = nnx.List(layer_norm(width, PAPER_EPSILON, rngs=rngs) for _ in range(3))
        moves = _moves(config, is_last)
        self.feed_forward = OffsetNetwork(width, config.ffn_expansion * width, rngs=rngs) if moves else None

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        surroundings: Surroundings,
        dropout_key: PRNGKeyArray | None = None,
    ) -> tuple[Float[Array, "batch query c"], Float[Array, "batch query 3"]]:
        """Return the updated embeddings and points."""
        after_queries, after_basis, after_nearest = self.norms
        keys = [None] * 2 if dropout_key is None else list(jax.random.split(dropout_key, 2))
        e = after_queries(embeddings + self.self_attention(embeddings, embeddings, keys[0]))
        e = after_basis(e + self.cross_attention(e, features[:, :: self.basis_stride], keys[1]))
        e = after_nearest(e + self.vector_attention(e, queries, features, surroundings.basis))
        return e, queries if self.feed_forward is None else queries + self.feed_forward(e)


class ReleaseLayer(nnx.Module):
    """Queries read the basis points twice, near queries, and near basis points; they move, then comes the
    feed-forward network."""

    def __init__(self, config: DecoderConfig, width: int, *, is_last: bool, rngs: nnx.Rngs) -> None:
        self.basis_stride, self.dropout_rate = config.cross_attention_basis_stride, config.dropout
        self.embed = linear(width, width, rngs=rngs)
        self.self_attention, self.cross_attention = _scalar_attentions(config, width, rngs)
        self.vector_attention = QueriesThenBasis(width, rngs=rngs)
        self.norms = nnx.List(layer_norm(width, RELEASE_EPSILON, rngs=rngs) for _ in range(2))
        moves = _moves(config, is_last)
        self.branch = OffsetNetwork(width, width, rngs=rngs) if moves else None
        # After the last offsets nobody reads the embeddings.
        unread = is_last and moves
        self.feed_forward = None if unread else ResidualNetwork(config, width, rngs=rngs)

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        surroundings: Surroundings,
        dropout_key: PRNGKeyArray | None = None,
    ) -> tuple[Float[Array, "batch query c"], Float[Array, "batch query 3"]]:
        """Return the updated embeddings and points."""
        keys = [None] * 5 if dropout_key is None else list(jax.random.split(dropout_key, 5))
        after_first, after_second = self.norms
        e = dropout(self.embed(embeddings), self.dropout_rate, keys[0])
        tokens = dropout(self.embed(features), self.dropout_rate, keys[1])
        basis = tokens[:, :: self.basis_stride]
        e = after_first(e + self.self_attention(e, basis, keys[2]))
        e = after_second(e + self.cross_attention(e, basis, keys[3]))
        e = self.vector_attention(e, queries, tokens, surroundings)
        if self.branch is not None:
            queries = queries + self.branch(e)
        return e if self.feed_forward is None else self.feed_forward(e, keys[4]), queries

    def with_deltas(self, queries: Float[Array, "1 query 3"], surroundings: Surroundings) -> Surroundings:
        """Compute beforehand what this layer needs of queries and neighbours that never move."""
        vector, near = self.vector_attention, surroundings
        assert near.queries is not None
        return Surroundings(
            vector.basis.attention.with_deltas(queries, near.basis),
            vector.queries.attention.with_deltas(queries, near.queries),
        )


def _scalar_attentions(
    config: DecoderConfig, width: int, rngs: nnx.Rngs
) -> tuple["MultiHeadAttention", "MultiHeadAttention"]:
    first, second = (
        MultiHeadAttention(width, config.num_heads, dropout_rate=config.dropout, rngs=rngs) for _ in range(2)
    )
    return first, second


def _moves(config: DecoderConfig, is_last: bool) -> bool:
    """Whether a layer regresses offsets; the last regresses these or parameters, never both."""
    return not is_last or config.output is DecoderOutput.OFFSETS


class QueriesThenBasis(nnx.Module):
    """Vector attention among the queries, then to the basis points (release)."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.queries, self.basis = (BracketedVectorAttention(width, rngs=rngs) for _ in range(2))

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        surroundings: Surroundings,
    ) -> Float[Array, "batch query c"]:
        """Return the updated embeddings."""
        assert surroundings.queries is not None
        embeddings = self.queries.among_queries(embeddings, queries, surroundings.queries)
        return self.basis.to_basis(embeddings, queries, features, surroundings.basis)


class OffsetNetwork(nnx.Module):
    """Two layers from embedding to offset; zero at first, so that learning starts from the template."""

    def __init__(self, width: int, hidden: int, *, rngs: nnx.Rngs) -> None:
        self.hidden = linear(width, hidden, rngs=rngs)
        self.offset = linear(hidden, 3, exact=True, zero=True, rngs=rngs)

    def __call__(self, embeddings: Float[Array, "batch query c"]) -> Float[Array, "batch query 3"]:
        """Regress offsets."""
        return self.offset(jax.nn.relu(self.hidden(embeddings)))


class ResidualNetwork(nnx.Module):
    """Feed-forward network of the embeddings: LayerNorm(e + W_2 gelu(W_1 e)), with the exact (erf) GELU."""

    def __init__(self, config: DecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.dropout_rate, hidden = config.dropout, config.ffn_expansion * width
        self.hidden, self.out = linear(width, hidden, rngs=rngs), linear(hidden, width, rngs=rngs)
        self.norm = layer_norm(width, RELEASE_EPSILON, rngs=rngs)

    def __call__(
        self, embeddings: Float[Array, "batch query c"], dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "batch query c"]:
        """Update."""
        update = self.out(jax.nn.gelu(self.hidden(embeddings), approximate=False))
        return self.norm(embeddings + dropout(update, self.dropout_rate, dropout_key))


class CoordinateEmbedding(nnx.Module):
    """Two layers from a coordinate to an embedding."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.hidden, self.out = linear(3, width, rngs=rngs), linear(width, width, rngs=rngs)

    def __call__(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch c"]:
        """Embed."""
        return self.out(jax.nn.relu(self.hidden(points)))


class MultiHeadAttention(nnx.Module):
    """softmax(Q K^T / sqrt(d / heads)) V, projected."""

    def __init__(self, width: int, num_heads: int, *, dropout_rate: float = 0.0, rngs: nnx.Rngs) -> None:
        self.num_heads, self.dropout_rate = num_heads, dropout_rate
        self.query, self.key, self.value, self.out = (linear(width, width, rngs=rngs) for _ in range(4))

    def __call__(
        self,
        queries: Float[Array, "batch query c"],
        tokens: Float[Array, "batch token c"],
        dropout_key: PRNGKeyArray | None = None,
        *,
        values: Float[Array, "batch token c"] | None = None,
        token_mask: Bool[Array, "batch token"] | None = None,
    ) -> Float[Array, "batch query c"]:
        """Let every query read all tokens; in training some of the weights and results are dropped.

        Args:
            queries: who reads.
            tokens: what the keys are made of, and the values too unless `values` are given.
            dropout_key: None drops nothing.
            values: what is read of the tokens.
            token_mask: True = a token that may be read, None = all. Of a sample without any, what is read
                means nothing, and is finite where the tokens are.
        """
        q, k, v = (
            self._heads(layer(x))
            for layer, x in (
                (self.query, queries),
                (self.key, tokens),
                (self.value, tokens if values is None else values),
            )
        )
        # One row a head, as in `_heads`.
        mask = None if token_mask is None else jnp.repeat(token_mask, self.num_heads, 0)
        if dropout_key is None:
            keys, out_key = None, None
        else:
            weights_key, out_key = jax.random.split(dropout_key)
            keys = jax.random.split(weights_key, len(q))
        attend = functools.partial(_attend, dropout_rate=self.dropout_rate)
        # One head of one sample at a time, recomputed in the backward pass: no array is larger than its map,
        # and each product is one plain matrix product, several times faster on a CPU than with heads inside.
        read = jax.lax.map(jax.checkpoint(attend), (q, k, v, keys, mask))  # pyright: ignore[reportPrivateImportUsage]
        return dropout(self.out(self._joined(read, len(queries))), self.dropout_rate, out_key)

    def _heads(self, x: Float[Array, "batch token c"]) -> Float[Array, "batch_head token c2"]:
        batch, token, c = x.shape
        split = x.reshape(batch, token, self.num_heads, c // self.num_heads)
        return jnp.swapaxes(split, 1, 2).reshape(batch * self.num_heads, token, c // self.num_heads)

    def _joined(self, read: Float[Array, "batch_head query c2"], batch: int) -> Float[Array, "batch query c"]:
        _, query, c = read.shape
        split = read.reshape(batch, self.num_heads, query, c)
        return jnp.swapaxes(split, 1, 2).reshape(batch, query, self.num_heads * c)


def _attend(
    arguments: tuple[Array, Array, Array, PRNGKeyArray | None, Array | None], *, dropout_rate: float
) -> Float[Array, "query c"]:
    """Let the queries of one head read its tokens."""
    q, k, v, key, mask = arguments
    # Half numbers would lose what tells logits apart, and their sums; products add up in float32 anyway.
    kept = jnp.promote_types(v.dtype, jnp.float32)
    logits = jnp.matmul(q * q.shape[-1] ** -0.5, k.T, preferred_element_type=kept)
    if mask is not None:
        # Not minus infinity, of which a row without any valid token would make NaN.
        logits = jnp.where(mask, logits, jnp.finfo(logits.dtype).min)
    weights = jnp.exp(logits - jax.lax.stop_gradient(jnp.max(logits, -1, keepdims=True)))
    total = jnp.sum(weights, -1, keepdims=True)
    # Divided last: the map is passed over once less.
    weights = dropout(weights, dropout_rate, key).astype(v.dtype)
    return (jnp.matmul(weights, v, preferred_element_type=kept) / total).astype(v.dtype)


class JointDecoder(DecoderRow):
    """A row of layers that each move the 21 joints, before they pose the template (ours, not the paper's).

    Triangulation joins the views by one point per heat map. A map says more: it is wide, or has two peaks,
    where the view does not know. Here every joint carries a small cloud of basis points, laid out in the
    hand's own frame; each point is given what the views' heat maps say of that joint there, the joints read
    each other, and move. After every layer the clouds stand at the new places and read the maps again.

    The hand's frame is spanned by palm and knuckles (rows: along the palm, across it, its normal). Written in
    it, places and offsets do not depend on how hand and cameras stand in the world, nor on which camera is
    primary.
    """

    def __init__(self, config: JointDecoderConfig, map_width: int, radius: float, *, rngs: nnx.Rngs) -> None:
        """Make the layers.

        Args:
            config: their sizes.
            map_width: channels of the feature maps.
            radius: metres; the joints' places about the root joint are told in this unit.
            rngs: where the weights are drawn from.
        """
        self.radius = radius
        self.layers = nnx.List(JointLayer(config, map_width, rngs=rngs) for _ in range(config.num_layers))

    def __call__(
        self,
        joints: Float[Array, "batch 21 3"],
        evidence: Float[Array, "batch view 21 h w"],
        feature_maps: Float[Array, "batch view h w c"],
        cams: Cameras,
        image_hw: tuple[int, int],
        *,
        training: bool = False,
    ) -> list[Float[Array, "batch 21 3"]]:
        """Return the joints after every layer, in the world of `cams`, metres.

        Args:
            joints: where they start.
            evidence: what each view says of each joint, from `point_features.evidence`.
            feature_maps: of the same views.
            cams: cameras of these views; masked ones say nothing.
            image_hw: size of the images.
            training: no gradient goes from a layer to those before it. What comes after the last layer may
                send it one.
        """
        moved = []
        for layer in self.layers:
            joints = jax.lax.stop_gradient(joints) if training else joints
            to_hand = palm_frame(joints)
            about_root = joints - joints[:, ROOT_JOINT, None]
            clouds = joints[:, :, None] + matmul(cloud(layer.shells_m).astype(joints.dtype), to_hand)[:, None]
            tokens = jnp.concatenate(
                [
                    rotate_points(to_hand, about_root) / self.radius,
                    read_evidence(evidence, cams, clouds, image_hw),
                    layer.pick(_mean(projected_features(feature_maps, cams, joints, image_hw)[0], cams)),
                ],
                -1,
            )
            joints = joints + rotate_points(transpose(to_hand), _OFFSET_M * self.run(layer, tokens))
            moved.append(joints)
        return moved


class JointLayer(nnx.Module):
    """Joints read each other and regress their offsets in the hand's frame."""

    def __init__(self, config: JointDecoderConfig, map_width: int, *, rngs: nnx.Rngs) -> None:
        self.shells_m = config.shells_m
        numbers = 3 + len(cloud(config.shells_m)) + config.picked_features
        self.pick = linear(map_width, config.picked_features, rngs=rngs)
        self.embed = Exact(normal(rngs.params(), (NUM_JOINTS, numbers, config.width), numbers**-0.5))
        self.names = Exact(normal(rngs.params(), (NUM_JOINTS, config.width), _EMBEDDING_SCALE))
        self.blocks = nnx.List(JointBlock(config, rngs=rngs) for _ in range(config.num_blocks))
        self.norm = layer_norm(config.width, PAPER_EPSILON, rngs=rngs)
        self.offset = linear(config.width, 3, exact=True, zero=True, rngs=rngs)

    def __call__(self, tokens: Float[Array, "batch 21 number"]) -> Float[Array, "batch 21 3"]:
        """Return the joints' offsets, in centimetres along the axes of the hand's frame."""
        x = jnp.einsum("bjn,jnc->bjc", tokens, self.embed[...]) + self.names[...]
        for block in self.blocks:
            x = block(x)
        return self.offset(self.norm(x))


class JointBlock(nnx.Module):
    """x + attention(norm(x)), then x + feed-forward(norm(x))."""

    def __init__(self, config: JointDecoderConfig, *, rngs: nnx.Rngs) -> None:
        width, hidden = config.width, config.ffn_expansion * config.width
        self.attention = MultiHeadAttention(width, config.num_heads, rngs=rngs)
        self.before_attention, self.before_hidden = (
            layer_norm(width, PAPER_EPSILON, rngs=rngs) for _ in range(2)
        )
        self.hidden, self.out = linear(width, hidden, rngs=rngs), linear(hidden, width, rngs=rngs)

    def __call__(self, x: Float[Array, "batch joint c"]) -> Float[Array, "batch joint c"]:
        """Let the joints read each other."""
        seen = self.before_attention(x)
        x = x + self.attention(seen, seen)
        return x + self.out(jax.nn.gelu(self.hidden(self.before_hidden(x))))


def cloud(shells_m: tuple[float, ...]) -> Float[np.ndarray, "point 3"]:
    """Return the basis points of one joint, metres about it along the axes of the hand's frame.

    The joint's own place, and shells of six points along the axes and of eight between them in turn.
    """
    shells = [radius * (_CORNERS if i % 2 else _AXES) for i, radius in enumerate(shells_m)]
    return np.concatenate([np.zeros((1, 3)), *shells]).astype(np.float32)


def read_evidence(
    evidence: Float[Array, "batch view 21 h w"],
    cams: Cameras,
    clouds_world: Float[Array, "batch 21 point 3"],
    image_hw: tuple[int, int],
) -> Float[Array, "batch 21 point"]:
    """Return what the views say, on average, of each joint at the points of its cloud.

    The mean over views of logarithms of probabilities: of the places that the views could mean, the one that
    all can agree to wins. Points outside an image or behind a camera get zero from it, which is
    what an even map says; such views count in the mean.
    """
    batch, joint, point, _ = clouds_world.shape
    uv_px, depth = project(cams.K, cams.T_cam_from_world, clouds_world.reshape(batch, 1, joint * point, 3))
    h, w = evidence.shape[-2:]
    cells = uv_px * (jnp.array([w, h], uv_px.dtype) / jnp.array(image_hw[::-1], uv_px.dtype))
    by_joint = (*uv_px.shape[:2], joint, point)
    said = sample_bilinear(evidence[..., None], cells.reshape(*by_joint, 2))[..., 0]
    said = jnp.where(depth.reshape(by_joint) > 0, said, 0)
    return _mean(said, cams)


def _mean(values: Float[Array, "batch view *rest"], cams: Cameras) -> Float[Array, "batch *rest"]:
    """Average over the valid views; zero where there is none."""
    mask: Bool[Array, "batch view"] = cams.view_mask
    count = jnp.maximum(jnp.sum(mask, -1), 1).reshape(-1, *[1] * (values.ndim - 2))
    kept = jnp.where(mask.reshape(*mask.shape, *[1] * (values.ndim - 2)), values, 0)
    return jnp.sum(kept, 1) / count.astype(values.dtype)
