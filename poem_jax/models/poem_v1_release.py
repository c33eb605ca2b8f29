"""The second stage of POEM v1 as released: where it differs from the paper's, in `poem_v1.py`.

    part             paper                                   release
    features         branch to 1/8, 1 x 1                    branch to 1/4, 2 x 2 max pooling, two 1 x 1
    positions        sines of the projected point            codes of the grid and of view, row, column
    aggregation      1/N, one view alone as it is            no 1/N, one view alone gets phi(0) added
    embedding        as it is                                mixed by two layers, plus the image feature there
    decoder          self-attention, vector attention        vector attention among the queries, then to the
                     to the basis, feed-forward network      basis; before, among the basis points
    coordinates      about the root, in ball radii           shares of a cuboid, moved as logits
    w/o-proj         channels (depth, feature)               channels (feature, depth)
    too few points   copies, which no search finds           points at the primary camera's centre
    queries          [V, J]                                  [J, V]

It has no layer norm, no feed-forward network and no dropout. Left out of the release: its error where more
than half of the projections' coordinates are outside the images, and the zeros that it puts in place of NaN.
Here linear maps begin by Xavier and offsets at zero, there by PyTorch's default.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.geometry.cameras import Cameras, primary_view
from poem_jax.geometry.sampling import sample_bilinear
from poem_jax.geometry.transforms import matmul, transform_points, transpose
from poem_jax.hand.model import HandModel, template_queries
from poem_jax.hand.topology import NUM_QUERIES, WRIST
from poem_jax.models.ball_query import points_at
from poem_jax.models.decoder import OffsetNetwork
from poem_jax.models.frustum import (
    denormalised,
    frustum_channels,
    normalised,
    point_sine_code,
    sigmoid_step,
)
from poem_jax.models.frustum_config import Cuboid
from poem_jax.models.layers import (
    Conv,
    DecoderRow,
    NormMode,
    PerQuery,
    TopDownBranch,
    linear,
    max_pool,
    uniform,
)
from poem_jax.models.network import Constant
from poem_jax.models.poem_v1_config import (
    BasisFeatures,
    PoemV1Config,
    PointDecoderConfig,
    QueryEmbedding,
)
from poem_jax.models.poem_v1_start import Scene
from poem_jax.models.point_features import ViewRowColumnCode
from poem_jax.models.vector_attention import BracketedVectorAttention, nearest_neighbours
from poem_jax.typing import Array, Bool, Float, Int

MIN_DEPTH = 1e-7
"""Metres. Projections divide by this where a point lies in a camera's plane."""
_CODED_COLUMNS = 3
"""Of the query table, whose sines stand in for the table in the model without projection."""


class ReleaseFeatures(nnx.Module):
    """Feature map of every view: the heat maps' branch again, pooled, and two 1 x 1 convolutions."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        trunk, self.pooling = config.backbone, config.pooling
        self.branch = TopDownBranch(trunk.channels, trunk.strides, config.branch_stride, bias=True, rngs=rngs)
        self.squeeze = Conv(self.branch.c_out, config.width // 2, 1, bias=True, rngs=rngs)
        self.project = Conv(config.width // 2, config.width, 1, bias=True, rngs=rngs)

    def __call__(self, levels: tuple[Array, ...], mode: NormMode) -> Float[Array, "image h w c"]:
        """Return the feature maps, without the codes of their cells' positions."""
        return self.project(self.squeeze(max_pool(self.branch(levels, mode), self.pooling)))


class CodedMaps(NamedTuple):
    """Feature maps of all views."""

    maps: Float[Array, "batch view h w c"]
    """With the codes of their cells' positions."""
    codes: Float[Array, "batch view h w c"]
    """These alone."""


class ReleasePoints(nnx.Module):
    """Second stage of the release."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.space, Cuboid)
        assert isinstance(config.decoder, PointDecoderConfig)
        self.cuboid = config.space
        self.position_code = CellCode(config, rngs=rngs)
        self.basis = _BASIS[config.basis_features](config, rngs=rngs)
        self.embedding = _EMBEDDINGS[config.query_embedding](config, hand, rngs=rngs)
        self.decoder = ReleaseDecoder(config.decoder, config.width, rngs=rngs)

    def __call__(self, scene: Scene) -> list[Float[Array, "batch query 3"]]:
        """Return the query points after every layer, metres in the primary camera's frame."""
        assert scene.index is not None
        cams, queries, points = scene.cams, scene.start.queries, points_at(scene.grid, scene.index)
        code = self.position_code(scene.grid, cams.view_mask)
        maps = CodedMaps(scene.feature_maps + code, code)
        features, query_features = self.basis(maps, cams, points, queries, scene.index)
        start, points = normalised(queries, self.cuboid), normalised(points, self.cuboid)
        embeddings = query_features + self.embedding(scene.pooled, cams.view_mask, start)
        moved = self.decoder(embeddings, start, features, points)
        return [denormalised(shares, self.cuboid) for shares in moved]


# Positions of cells.


class CellCode(nnx.Module):
    """Code of a cell's position: of the logits of its grid points' shares of the cuboid, by two layers, and
    of view, row and column."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.space, Cuboid)
        self.cuboid, width = config.space, config.width
        self.hidden = Conv(3 * config.basis.frustum.num_depths, 2 * width, 1, bias=True, rngs=rngs)
        self.out = Conv(2 * width, width, 1, bias=True, rngs=rngs)
        self.view_row_column = ViewRowColumnCode(width, rngs=rngs)

    def __call__(
        self, grid: Float[Array, "batch view w h depth 3"], view_mask: Bool[Array, "batch view"]
    ) -> Float[Array, "batch view h w c"]:
        """Return what is added to each view's map; what masked views get means nothing."""
        channels = frustum_channels(grid, self.cuboid)
        encoded = self.out(jax.nn.relu(self.hidden(channels.reshape(-1, *channels.shape[2:]))))
        return encoded.reshape(*channels.shape[:-1], -1) + self.view_row_column(
            view_mask, channels.shape[2:4]
        )


# Features of the basis points, and of the query points.


class UnnormalisedAggregation(DecoderRow):
    """f1 + phi(sum_j theta(f1) . theta(fj) theta(fj)), j over the valid views but the primary; phi's hidden
    layer is as narrow as its input."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        half = width // 2
        self.theta_in, self.theta_out = linear(width, width, rngs=rngs), linear(width, half, rngs=rngs)
        self.phi_in, self.phi_out = linear(half, half, rngs=rngs), linear(half, width, rngs=rngs)

    def __call__(
        self,
        features: Float[Array, "batch view point c"],
        view_mask: Bool[Array, "batch view"],
    ) -> Float[Array, "batch point c"]:
        """Fuse the valid views into the primary one."""
        return self.lean(self._fused)(features, view_mask)

    def _fused(self, features: Array, view_mask: Array) -> Float[Array, "batch point c"]:
        primary = primary_view(view_mask)
        theta = self.theta_out(jax.nn.relu(self.theta_in(features)))
        similarity = jnp.sum(theta * _of_view(theta, primary)[:, None], -1)
        sources = view_mask & (jnp.arange(view_mask.shape[-1]) != primary[:, None])
        weights = jnp.where(sources[..., None], similarity, 0)
        mixed = jnp.sum(weights[..., None] * theta, 1)
        return _of_view(features, primary) + self.phi_out(jax.nn.relu(self.phi_in(mixed)))


def _of_view(
    values: Float[Array, "batch view point c"], index: Int[Array, " batch"]
) -> Float[Array, "batch point c"]:
    return jnp.take_along_axis(values, index[:, None, None, None], axis=1)[:, 0]


class ProjectedRelease(nnx.Module):
    """Basis and query points read the maps of all views where they project; basis points are told the sum of
    the codes there, too."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        self.image_hw = config.image_hw
        self.fuse_basis = UnnormalisedAggregation(config.width, rngs=rngs)
        self.fuse_queries = UnnormalisedAggregation(config.width, rngs=rngs)

    def __call__(
        self,
        coded: CodedMaps,
        cams: Cameras,
        points: Float[Array, "batch basis 3"],
        queries: Float[Array, "batch query 3"],
        index: Int[Array, "batch basis"],
    ) -> tuple[Float[Array, "batch basis c"], Float[Array, "batch query c"]]:
        """Return the features of basis and query points."""
        at_basis = self.sampled(coded.maps, cams, points)
        at_queries = self.sampled(coded.maps, cams, queries)
        shown = cams.view_mask[..., None, None]
        told = jnp.sum(jnp.where(shown, self.sampled(coded.codes, cams, points), 0), 1)
        return (
            self.fuse_basis(at_basis, cams.view_mask) + told,
            self.fuse_queries(at_queries, cams.view_mask),
        )

    def sampled(
        self,
        maps: Float[Array, "batch view h w c"],
        cams: Cameras,
        points: Float[Array, "batch point 3"],
    ) -> Float[Array, "batch view point c"]:
        """Sample every view where points project, also those behind a camera; zeros outside."""
        uv_px = projected_anyhow(cams, points)
        stride_wh = jnp.array(
            [self.image_hw[1] / maps.shape[-2], self.image_hw[0] / maps.shape[-3]], uv_px.dtype
        )
        return sample_bilinear(maps, uv_px / stride_wh)


def projected_anyhow(
    cams: Cameras, points: Float[Array, "batch point 3"]
) -> Float[Array, "batch view point 2"]:
    """Project points as the release does: K p, divided by its depth, whatever its sign; by `MIN_DEPTH` where
    it is nearer to zero, so that a camera's own centre projects to pixel (0, 0)."""
    points_cam = transform_points(cams.T_cam_from_world, points[:, None])
    homogeneous = matmul(points_cam, transpose(cams.K))
    depth = homogeneous[..., 2:]
    return homogeneous[..., :2] / jnp.where(jnp.abs(depth) < MIN_DEPTH, MIN_DEPTH, depth)


class OwnCameraRelease(nnx.Module):
    """A basis point has the channels of its depth in its own camera's cell, enlarged by one layer; query
    points read no image. A cell's channels are (feature, depth)."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        self.depths = config.basis.frustum.num_depths
        self.enlarge = linear(config.width // self.depths, config.width, rngs=rngs)

    def __call__(
        self,
        coded: CodedMaps,
        cams: Cameras,
        points: Float[Array, "batch basis 3"],
        queries: Float[Array, "batch query 3"],
        index: Int[Array, "batch basis"],
    ) -> tuple[Float[Array, "batch basis c"], Float[Array, ""]]:
        """Return the features of basis points, and zero."""
        batch, view, h, w, c = coded.maps.shape
        by_point = jnp.swapaxes(coded.maps.reshape(batch, view, h, w, c // self.depths, self.depths), -1, -2)
        return self.enlarge(own_channels(by_point, index)), jnp.zeros((), coded.maps.dtype)


def own_channels(
    by_point: Float[Array, "batch view h w depth c"], index: Int[Array, "batch basis"]
) -> Float[Array, "batch basis c"]:
    """Return the channels that belong to grid points.

    Args:
        by_point: the channels of every cell, shared out among its depths.
        index: numbers in the grid (view, w, h, depth), flattened; -1 reads zeros.
    """
    rows = jnp.swapaxes(by_point, 2, 3).reshape(len(by_point), -1, by_point.shape[-1])
    taken = jax.vmap(lambda table, i: table[i])(rows, jnp.maximum(index, 0))
    return jnp.where((index >= 0)[..., None], taken, 0)


_BASIS = {BasisFeatures.PROJECTED: ProjectedRelease, BasisFeatures.OWN_CAMERA: OwnCameraRelease}


# Query embeddings: two layers after what tells the queries apart.


class _MixedEmbedding(nnx.Module):
    """Two layers from the numbers that a subclass gives each query."""

    def __init__(self, numbers: int, width: int, *, rngs: nnx.Rngs) -> None:
        self.hidden, self.out = linear(numbers, width, rngs=rngs), linear(width, width, rngs=rngs)

    def _numbers(
        self,
        pooled: Float[Array, "batch view c"],
        view_mask: Bool[Array, "batch view"],
        start: Float[Array, "batch query 3"],
    ) -> Float[Array, "*#batch query c2"]:
        raise NotImplementedError

    def __call__(
        self,
        pooled: Float[Array, "batch view c"],
        view_mask: Bool[Array, "batch view"],
        start: Float[Array, "batch query 3"],
    ) -> Float[Array, "*#batch query c2"]:
        """Return the embeddings.

        Args:
            pooled: mean of every view's coarsest map.
            view_mask: views that count.
            start: first query points, shares of the cuboid.
        """
        return self.out(jax.nn.relu(self.hidden(self._numbers(pooled, view_mask, start))))


def _table(config: PoemV1Config, rngs: nnx.Rngs) -> PerQuery:
    return PerQuery(uniform(rngs.params(), (NUM_QUERIES, config.width)))


def _template(config: PoemV1Config, hand: HandModel) -> Constant:
    """Return the flat mean hand about its wrist, metres."""
    return Constant(jnp.asarray(template_queries(hand, config.query_order, center_joint=WRIST)))


class TableEmbedding(_MixedEmbedding):
    """V-emb, the release's "KPT": a table."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        super().__init__(config.width, config.width, rngs=rngs)
        self.table = _table(config, rngs)

    def _numbers(self, pooled: Array, view_mask: Array, start: Array) -> Float[Array, "*#batch query c"]:
        return self.table[...][None]


class GlobalEmbedding(_MixedEmbedding):
    """G-emb, the release's "METRO": the sum of the views' global features beside the template."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        super().__init__(config.width + 3, config.width, rngs=rngs)
        self.to_global = linear(config.backbone.channels[-1], config.width, rngs=rngs)
        self.template = _template(config, hand)

    def _numbers(self, pooled: Array, view_mask: Array, start: Array) -> Float[Array, "*#batch query c"]:
        summed = _global_sum(self.to_global, pooled, view_mask)
        summed = jnp.broadcast_to(summed, (*start.shape[:-1], summed.shape[-1]))
        return jnp.concatenate([summed, jnp.broadcast_to(self.template[...], start.shape)], -1)


class GlobalAndTableEmbedding(_MixedEmbedding):
    """G&V-emb, the release's "MVP": the same sum plus the table."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        super().__init__(config.width, config.width, rngs=rngs)
        self.to_global = linear(config.backbone.channels[-1], config.width, rngs=rngs)
        self.table = _table(config, rngs)

    def _numbers(self, pooled: Array, view_mask: Array, start: Array) -> Float[Array, "*#batch query c"]:
        return _global_sum(self.to_global, pooled, view_mask) + self.table[...]


def _global_sum(
    to_global: nnx.Linear, pooled: Float[Array, "batch view c"], view_mask: Bool[Array, "batch view"]
) -> Float[Array, "batch 1 c2"]:
    """Sum over the valid views; the layer's bias comes once a view."""
    return jnp.sum(jnp.where(view_mask[..., None], to_global(pooled), 0), 1, keepdims=True)


class PointsEmbedding(_MixedEmbedding):
    """The release's "POEM": the table, the first query point and its place on the template."""

    def __init__(self, config: PoemV1Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        super().__init__(self._table_numbers(config) + 6, config.width, rngs=rngs)
        self.table, self.template = _table(config, rngs), _template(config, hand)

    @staticmethod
    def _table_numbers(config: PoemV1Config) -> int:
        return config.width

    def _of_table(self) -> Float[Array, "query c"]:
        return self.table[...]

    def _numbers(self, pooled: Array, view_mask: Array, start: Array) -> Float[Array, "*#batch query c"]:
        table = self._of_table()
        parts = (jnp.broadcast_to(table, (*start.shape[:-1], table.shape[-1])), start)
        return jnp.concatenate([*parts, jnp.broadcast_to(self.template[...], start.shape)], -1)


class PointCodesEmbedding(PointsEmbedding):
    """The same with sines of the table's first three columns in its place."""

    @staticmethod
    def _table_numbers(config: PoemV1Config) -> int:
        return _CODED_COLUMNS * (config.width // 2)

    def _of_table(self) -> Float[Array, "query c"]:
        table = self.table[...]
        return point_sine_code(table[:, :_CODED_COLUMNS], table.shape[-1] // 2)


_EMBEDDINGS = {
    QueryEmbedding.VERTEX: TableEmbedding,
    QueryEmbedding.GLOBAL: GlobalEmbedding,
    QueryEmbedding.GLOBAL_AND_VERTEX: GlobalAndTableEmbedding,
    QueryEmbedding.POINTS: PointsEmbedding,
    QueryEmbedding.POINT_CODES: PointCodesEmbedding,
}


# Decoder.


class ReleaseDecoder(DecoderRow):
    """Basis points read each other once; then, layer by layer, queries read each other and the basis points,
    and move. Neighbours are searched anew in every layer."""

    def __init__(self, config: PointDecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.num_neighbours = config.num_neighbours
        self.among_basis = BracketedVectorAttention(width, rngs=rngs)
        self.layers = nnx.List(ReleaseLayer(config, width, rngs=rngs) for _ in range(config.num_layers))

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        points: Float[Array, "batch basis 3"],
    ) -> list[Float[Array, "batch query 3"]]:
        """Return the query points after every layer; all coordinates are shares of the cuboid."""
        near = nearest_neighbours(points, points, self.num_neighbours)
        features = self.among_basis.among_queries(features, points, near)
        moved = []
        for layer in self.layers:
            embeddings, queries = self.run(layer, embeddings, queries, features, points)
            moved.append(queries)
        return moved


class ReleaseLayer(nnx.Module):
    """Vector attention among the queries and to the basis; logits of the coordinates move."""

    def __init__(self, config: PointDecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.num_neighbours = config.num_neighbours
        self.queries, self.basis = (BracketedVectorAttention(width, rngs=rngs) for _ in range(2))
        self.branch = OffsetNetwork(width, width, rngs=rngs)

    def __call__(
        self,
        embeddings: Float[Array, "batch query c"],
        queries: Float[Array, "batch query 3"],
        features: Float[Array, "batch basis c"],
        points: Float[Array, "batch basis 3"],
    ) -> tuple[Float[Array, "batch query c"], Float[Array, "batch query 3"]]:
        """Return the updated embeddings and points."""
        near = nearest_neighbours(queries, queries, self.num_neighbours)
        embeddings = self.queries.among_queries(embeddings, queries, near)
        near = nearest_neighbours(queries, points, self.num_neighbours)
        embeddings = self.basis.to_basis(embeddings, queries, features, near)
        return embeddings, sigmoid_step(queries, self.branch(embeddings))
