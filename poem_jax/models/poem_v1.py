"""POEM v1, the paper's conference model, with its ablations; as in the paper and as released.

    views -> trunk -> branch -> heat maps -> 21 joints, triangulated -> linear map -> 799 query points
                   -> branch -> feature maps
    grids before the cameras -> ball about the hand -> basis points
    feature maps at the basis points' projections -> projective aggregation -> basis features
    query embeddings -> decoder: queries read each other and the basis points near them, and move

Paper: "Misc. Modifications on the POEM Model" (what v1 has in place of v2's parts), "Implementation Details"
(numbers), "Ablation Study". The first stage is in `poem_v1_start.py`; the second stage of the release is in
`poem_v1_release.py`, with a table of what differs. The ablations:

    1stage      no heat maps: `LearnedStart`, and coordinates that are shares of a cuboid
    w/o-proj    `OwnCameraFeatures`: a basis point has a feature of the camera in whose grid it stands
    w/o-pt      `PaperTokens`: PE-MeshTR's fusion and decoder, queries about the root
    G-emb ...   `GlobalEmbedding`, `GlobalAndVertexEmbedding`

Where the paper says nothing, decided here for its models:

- as in v2: the DLT's rows have unit norm, coordinates count in radii of the ball, sines of the projected
  point are added to its samples, layers are post-norm, attentions have 4 heads, a layer's network goes
  d -> 4 d -> 3;
- linear maps begin by Xavier, as the paper says, but those to a layer's offsets at zero, and that to the
  vertices as the joints' mean: learning starts from what was triangulated;
- a known root replaces joint 9 for the ball and the coordinates; joints that were triangulated start where
  they were, the others at the root;
- grid points lie on rays through the cells' centres; a ball that holds fewer points than are wanted is filled
  up with copies, which no search for neighbours finds unless it holds fewer than k;
- 1stage: points move as logits of their shares, as PE-MeshTR's, for they are regressed "within these
  predefined boundaries";
- w/o-proj: one linear layer enlarges the C / D channels of a point;
- w/o-pt: queries start as v1's do, and v1's embeddings are DETR's codes; one network of three layers makes
  offsets from there of every layer's embeddings;
- G is the mean over the views of a linear map of the pooled last feature; another brings G-emb to d channels.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, primary_view
from poem_jax.hand.model import HandModel, template_queries
from poem_jax.hand.topology import NUM_QUERIES
from poem_jax.models.aggregation import ProjectiveAggregation
from poem_jax.models.backbones import ResNet
from poem_jax.models.ball_query import draw_ball, filled, points_at
from poem_jax.models.config import AggregationConfig, Design, RootConfig
from poem_jax.models.decoder import PAPER_EPSILON, MultiHeadAttention, OffsetNetwork
from poem_jax.models.detr import DetrDecoder
from poem_jax.models.frustum import frustum_grid
from poem_jax.models.heat_maps import HeatMapBranch
from poem_jax.models.layers import (
    Conv,
    DecoderRow,
    NormMode,
    PerQuery,
    TopDownBranch,
    layer_norm,
    linear,
    normal,
    trunk_images,
)
from poem_jax.models.mesh_transformers import EmbeddedPositions, ReadOutNetwork
from poem_jax.models.network import Constant, HandConstants
from poem_jax.models.poem_v1_config import (
    BasisFeatures,
    PoemV1Config,
    PointDecoderConfig,
    QueryEmbedding,
    TokenDecoderConfig,
)
from poem_jax.models.poem_v1_release import ReleaseFeatures, ReleasePoints, own_channels
from poem_jax.models.poem_v1_start import (
    LearnedStart,
    Move,
    ReleaseStart,
    Scene,
    Start,
    TriangulatedStart,
    ViewFeatures,
    space_of,
)
from poem_jax.models.point_features import projected_features, sine_code
from poem_jax.models.vector_attention import Neighbours, VectorAttention, nearest_neighbours
from poem_jax.models.world_frame import Reconstruction, WorkingFrame, leave_working_frame
from poem_jax.typing import Array, Bool, Float, Int, Num, PRNGKeyArray


class Basis(NamedTuple):
    """Which grid points are basis points."""

    index: Int[Array, "batch basis"] | None
    """None where the decoder reads no basis points."""
    found: Bool[Array, " batch"]
    """False where there should be some and are none."""


class PoemV1(nnx.Module):
    """POEM v1 and its ablations, by config."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.config = config
        by_paper, first = config.design is Design.PAPER, config.first_stage
        self.trunk = ResNet(config.backbone, rngs=rngs)
        if isinstance(first, RootConfig):
            self.heat_maps = HeatMapBranch(first, config.backbone, rngs=rngs)
            self.start = (TriangulatedStart if by_paper else ReleaseStart)(config, rngs=rngs)
        else:
            self.heat_maps, self.start = None, LearnedStart(config, rngs=rngs)
        self.features = (PaperFeatures if by_paper else ReleaseFeatures)(config, rngs=rngs)
        if isinstance(config.decoder, PointDecoderConfig):
            self.second = (PaperPoints if by_paper else ReleasePoints)(config, hand, rngs=rngs)
        else:
            self.second = PaperTokens(config, hand, rngs=rngs)
        self.hand = HandConstants(hand)

    def look(
        self, views: Num[Array, "*batch h w 3"], mode: NormMode, settled: NormMode | None = None
    ) -> ViewFeatures:
        """Do what is done with every view alone: trunk, heat maps and feature map; any leading axes."""
        settled = mode if settled is None else settled
        levels = self.trunk(trunk_images(views, self.config, self.hand.model().v_template.dtype), settled)
        heat = (None, None) if self.heat_maps is None else self.heat_maps(levels, settled)
        seen = ViewFeatures(*heat, self.features(levels, mode), jnp.mean(levels[-1], (1, 2)))
        return jax.tree.map(lambda leaf: leaf.reshape(*views.shape[:-3], *leaf.shape[1:]), seen)

    def find_hands(
        self,
        seen: ViewFeatures,
        frame: WorkingFrame,
        mode: NormMode,
        *,
        dropout_key: PRNGKeyArray | None = None,
        ball_index: Int[Array, "batch basis"] | None = None,
        key: PRNGKeyArray | None = None,
    ) -> Prediction:
        """Join what was seen in the views (batch, view) to one hand per sample, in the user's world.

        Args:
            seen: from `look`.
            frame: the working frame.
            mode: whether this is training.
            dropout_key: for what is dropped in training, by PE-MeshTR's decoder alone.
            ball_index: numbers of the basis points in each sample's grid (view, w, h, depth), flattened; -1
                stands for a point at the primary camera's centre in the release, and for none in the paper's
                design. None = drawn.
            key: what they are drawn with; None = key 0.

        Returns: the prediction. A sample is not valid where its root cannot be found (release: any joint), or
        where no grid point lies in its ball.
        """
        start = self.start(seen, frame)
        cams = Cameras(*map(jnp.asarray, frame.cams))
        grid = frustum_grid(self.config.basis.frustum, cams, self.config.map_hw, self.config.image_hw)
        basis = self._basis(ball_index, grid, start, cams, key)
        layers = self.second(
            Scene(seen.feature_maps, seen.pooled, cams, grid, basis.index, start, dropout_key)
        )
        found = Reconstruction(
            seen.keypoints_px,
            seen.heat_maps,
            start.joints,
            start.root,
            start.valid & basis.found & jnp.any(cams.view_mask, -1),
            jnp.stack(layers, 1),
            parameters=None,
            reference_mask=start.solved,
        )
        return leave_working_frame(found, frame, self.hand.model(), self.config.query_order)

    def _basis(
        self,
        ball_index: Array | None,
        grid: Float[Array, "batch view w h depth 3"],
        start: Start,
        cams: Cameras,
        key: PRNGKeyArray | None,
    ) -> Basis:
        if self.config.grid_draw is None:
            return Basis(None, jnp.ones(len(grid), bool))
        if ball_index is not None:
            return Basis(ball_index, jnp.any(ball_index >= 0, -1))
        key = jax.random.key(0) if key is None else key
        ball = draw_ball(self.config.basis, grid, start.centre, cams.view_mask, key)
        return Basis(ball.index, ball.count > 0)


# Second stage of the paper.


class PaperFeatures(nnx.Module):
    """Feature map of every view: the heat maps' branch again, with own weights, and a 1 x 1 convolution."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        trunk = config.backbone
        self.branch = TopDownBranch(trunk.channels, trunk.strides, config.stride, rngs=rngs)
        self.project = Conv(self.branch.c_out, config.width, 1, bias=True, rngs=rngs)

    def __call__(self, levels: tuple[Array, ...], mode: NormMode) -> Float[Array, "image h w c"]:
        """Return the feature maps."""
        return self.project(self.branch(levels, mode))


class PaperPoints(nnx.Module):
    """Basis points with features, query points with embeddings, and the decoder."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.decoder, PointDecoderConfig)
        self.config = config
        self.basis = _BASIS[config.basis_features](config, rngs=rngs)
        self.embedding = _EMBEDDINGS[config.query_embedding](config, hand, rngs=rngs)
        self.decoder = PaperDecoder(config.decoder, config.width, rngs=rngs)

    def __call__(self, scene: Scene) -> list[Float[Array, "batch query 3"]]:
        """Return the query points after every layer, metres in the primary camera's frame."""
        assert scene.index is not None
        held, index = scene.index >= 0, filled(scene.index)
        space = space_of(self.config, scene.start.root)
        basis = points_at(scene.grid, index)
        features = self.basis(scene.feature_maps, scene.cams, basis, index)
        embeddings = self.embedding(scene.pooled, scene.cams.view_mask)
        embeddings = jnp.broadcast_to(embeddings, (len(features), *embeddings.shape[1:]))
        queries, points = space.enter(scene.start.queries), space.enter(basis)
        moved = self.decoder(embeddings, queries, features, points, held, space.move)
        return [space.leave(layer) for layer in moved]


class ProjectedFeatures(nnx.Module):
    """Basis points read all views where they project, are told where that is, and views are fused (paper,
    eq. 5 to 8)."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        self.image_hw = config.image_hw
        self.aggregation = ProjectiveAggregation(AggregationConfig(), config.width, rngs=rngs)

    def __call__(
        self,
        maps: Float[Array, "batch view h w c"],
        cams: Cameras,
        points: Float[Array, "batch basis 3"],
        index: Int[Array, "batch basis"],
    ) -> Float[Array, "batch basis c"]:
        """Return the features of the basis points."""
        sampled, uv_share = projected_features(maps, cams, points, self.image_hw)
        told = sampled + sine_code(uv_share, sampled.shape[-1]).astype(sampled.dtype)
        return self.aggregation(told, cams.view_mask, primary_view(cams.view_mask))


class OwnCameraFeatures(nnx.Module):
    """A basis point has the channels of its depth in its own camera's cell, B_cam reshaped to (W, H, D, C /
    D), enlarged to d by one layer (ablation w/o-proj)."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        self.depths = config.basis.frustum.num_depths
        self.enlarge = linear(config.width // self.depths, config.width, rngs=rngs)

    def __call__(
        self,
        maps: Float[Array, "batch view h w c"],
        cams: Cameras,
        points: Float[Array, "batch basis 3"],
        index: Int[Array, "batch basis"],
    ) -> Float[Array, "batch basis c"]:
        """Return the features of the basis points."""
        batch, view, h, w, c = maps.shape
        by_point = maps.reshape(batch, view, h, w, self.depths, c // self.depths)
        return self.enlarge(own_channels(by_point, index))


_BASIS = {BasisFeatures.PROJECTED: ProjectedFeatures, BasisFeatures.OWN_CAMERA: OwnCameraFeatures}


class VertexEmbedding(nnx.Module):
    """V-emb: a learned embedding of each query."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.table = PerQuery(normal(rngs.params(), (NUM_QUERIES, config.width)))

    def __call__(
        self, pooled: Float[Array, "batch view c"], view_mask: Bool[Array, "batch view"]
    ) -> Float[Array, "1 query c2"]:
        """Return the embeddings, the same for every sample."""
        return self.table[...][None]


class GlobalEmbedding(nnx.Module):
    """G-emb: the mean of the views' last features beside the query's place on the template, which counts in
    radii of the ball about the root joint."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.to_global = linear(config.backbone.channels[-1], config.width, rngs=rngs)
        self.mix = linear(config.width + 3, config.width, rngs=rngs)
        template = template_queries(hand, config.query_order) / config.basis.radius
        self.template = Constant(jnp.asarray(template, jnp.float32))

    def __call__(
        self, pooled: Float[Array, "batch view c"], view_mask: Bool[Array, "batch view"]
    ) -> Float[Array, "batch query c2"]:
        """Return the embeddings."""
        overall, template = _global_mean(self.to_global, pooled, view_mask), self.template[...]
        shape = (len(overall), NUM_QUERIES)
        parts = [overall[:, None], template[None]]
        beside = [jnp.broadcast_to(part, (*shape, part.shape[-1])) for part in parts]
        return self.mix(jnp.concatenate(beside, -1))


class GlobalAndVertexEmbedding(nnx.Module):
    """G&V-emb: the mean of the views' last features plus a learned embedding of each query."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.to_global = linear(config.backbone.channels[-1], config.width, rngs=rngs)
        self.table = PerQuery(normal(rngs.params(), (NUM_QUERIES, config.width)))

    def __call__(
        self, pooled: Float[Array, "batch view c"], view_mask: Bool[Array, "batch view"]
    ) -> Float[Array, "batch query c2"]:
        """Return the embeddings."""
        return _global_mean(self.to_global, pooled, view_mask)[:, None] + self.table[...]


def _global_mean(
    to_global: nnx.Linear, pooled: Float[Array, "batch view c"], view_mask: Bool[Array, "batch view"]
) -> Float[Array, "batch c2"]:
    """Average over the valid views; zero where there is none."""
    weights = view_mask / jnp.maximum(jnp.sum(view_mask, -1, keepdims=True), 1)
    return jnp.sum(weights[..., None].astype(pooled.dtype) * to_global(pooled), 1)


_EMBEDDINGS = {
    QueryEmbedding.VERTEX: VertexEmbedding,
    QueryEmbedding.GLOBAL: GlobalEmbedding,
    QueryEmbedding.GLOBAL_AND_VERTEX: GlobalAndVertexEmbedding,
}


class PaperTokens(nnx.Module):
    """PE-MeshTR's fusion and decoder in place of basis points; query points move about the root (ablation
    w/o-pt).

    As in PE-MeshTR every layer's embeddings give an offset from the first query points, by one network.
    """

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.decoder, TokenDecoderConfig)
        self.config = config
        self.fusion = EmbeddedPositions(config.as_mesh_transformer(config.decoder), rngs=rngs)
        self.embedding = _EMBEDDINGS[config.query_embedding](config, hand, rngs=rngs)
        self.decoder = DetrDecoder(config.decoder.detr, config.width, rngs=rngs)
        self.offsets = ReadOutNetwork(config.width, rngs=rngs)

    def __call__(self, scene: Scene) -> list[Float[Array, "batch query 3"]]:
        """Return the query points after every layer, metres in the primary camera's frame."""
        tokens = self.fusion(scene.feature_maps, scene.cams, NormMode())
        codes = self.embedding(scene.pooled, scene.cams.view_mask)
        codes = jnp.broadcast_to(codes, (len(scene.pooled), *codes.shape[1:]))
        embeddings = self.decoder(codes, tokens.values, tokens.codes, tokens.mask, scene.dropout_key)
        space = space_of(self.config, scene.start.root)
        offsets, queries = self.offsets(embeddings), space.enter(scene.start.queries)
        return [space.leave(space.move(queries, offsets[:, i])) for i in range(offsets.shape[1])]


class PaperDecoder(DecoderRow):
    """A row of layers that each move the query points; neighbours are searched anew in every layer."""

    def __init__(self, config: PointDecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.num_neighbours = config.num_neighbours
        self.layers = nnx.List(PaperLayer(config, width, rngs=rngs) for _ in range(config.num_layers))

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        points: Float[Array, "batch basis 3"],
        point_mask: Bool[Array, "batch basis"],
        move: Move,
    ) -> list[Float[Array, "batch query 3"]]:
        """Return the query points after every layer, in the coordinates of `queries` and `points`.

        Args:
            embeddings: of the queries.
            queries: where they start.
            features: of the basis points.
            points: where these stand.
            point_mask: False = a copy, which is read only where fewer than k points are none.
            move: how points move by an offset in these coordinates.
        """
        moved = []
        for layer in self.layers:
            near = nearest_neighbours(queries, points, self.num_neighbours, point_mask)
            embeddings, offset = self.run(layer, embeddings, queries, features, near)
            queries = move(queries, offset)
            moved.append(queries)
        return moved


class PaperLayer(nnx.Module):
    """v2's layer without the cross-attention: queries read each other and their nearest basis points; then
    the feed-forward network says how they move."""

    def __init__(self, config: PointDecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.self_attention = MultiHeadAttention(width, config.num_heads, rngs=rngs)
        self.vector_attention = VectorAttention(width, rngs=rngs)
        self.norms = nnx.List(layer_norm(width, PAPER_EPSILON, rngs=rngs) for _ in range(2))
        self.feed_forward = OffsetNetwork(width, config.ffn_expansion * width, rngs=rngs)

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        near: Neighbours,
    ) -> tuple[Float[Array, "batch query c"], Float[Array, "batch query 3"]]:
        """Return the updated embeddings, and offsets of the points."""
        after_queries, after_nearest = self.norms
        e = after_queries(embeddings + self.self_attention(embeddings, embeddings))
        e = after_nearest(e + self.vector_attention(e, queries, features, near))
        return e, self.feed_forward(e)
