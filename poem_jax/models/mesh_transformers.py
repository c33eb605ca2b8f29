"""PE-MeshTR and FTL-MeshTR, the paper's own baselines: image tokens of all views, told where they stand, and
a decoder whose 799 embeddings read them and become points (paper, section "Main experiments").

    views -> trunk -> map at 1/8, d channels -> [fusion] -> tokens of all views
    query codes (799, d) -> DETR's decoder, which reads the tokens -> network of three layers, shared by all
    decoder layers -> sigmoid -> points in the cuboid, in the primary camera's frame

There is no first stage and no root: points are regressed where they are. Paper and release differ in:

    part       paper                                       release
    map        whole trunk and a branch back up to 1/8     the trunk's map at 1/8
    PE         channels (D, C / D), sines of each grid     code of the grid's logits and code of view, row and
               point added (`EmbeddedPositions`)           column, in the keys alone (`EncodedPositions`)
    FTL        points to the world, all views through      view by view: points to the world and by K^-1, then
               one convolution (`CanonicalMaps`)           by K T^-1, three convolutions (`PixelUnitMaps`)
    queries    a learned embedding of each                 codes of learned points; PE: and of the template
    start      the middle of the cuboid                    the learned points, through a sigmoid
    order      [V, J]                                      [J, V]

Where the paper says nothing, the release is followed: 6 layers of 8 heads, 2048 hidden channels, dropout
0.1, the norm and the network after the decoder, 32 points of FTL. And decided here, for the paper's models:

- the map is POEM's own: trunk and up-sampling branch to 1/8, 1 x 1 convolution to d;
- the grid has D = 32 depths of linearly increasing steps, as POEM v1's, on rays through the cells' centres;
- FTL's tokens have the release's code of view, row and column in their keys: DETR's decoder has to know where
  a token stands, and canonical features do not say it;
- FTL's points come from the map by a 1 x 1 convolution, for 256 channels are no multiple of 3, and its
  fusing convolution is 1 x 1; neither has a norm or a ReLU;
- the sines of a grid point begin with waves of twice the cuboid, and double in frequency;
- `E_X` is what DETR calls query embeddings: added to queries and keys of every layer, the first of which
  begins with zeros, where the paper's section on query points has it as the first layer's input;
- the queries are `E_X` alone: of METRO the paper says that its tokens hold image features and the template's
  coordinates, and "we adopt similar design", but then that the query tokens are `E_X`;
- points are shares of the cuboid that the ablation of one stage names, starting from its middle.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, invert_intrinsics
from poem_jax.geometry.transforms import invert_rigid, matmul, transform_points
from poem_jax.hand.model import HandModel, template_queries
from poem_jax.hand.topology import NUM_QUERIES, WRIST
from poem_jax.models.backbones import ResNet
from poem_jax.models.config import Design
from poem_jax.models.detr import DetrDecoder
from poem_jax.models.frustum import (
    denormalised,
    frustum_channels,
    frustum_grid,
    normalised,
    point_sine_code,
    sigmoid_step,
    view_row_column_code,
)
from poem_jax.models.layers import (
    Conv,
    ConvNorm,
    Exact,
    NormMode,
    PerQuery,
    TopDownBranch,
    linear,
    normal,
    trunk_images,
    uniform,
)
from poem_jax.models.mesh_transformer_config import (
    CanonicalFusion,
    MeshTransformerConfig,
    PositionEmbeddedFusion,
)
from poem_jax.models.network import HandConstants
from poem_jax.models.point_features import valid_views_first
from poem_jax.models.world_frame import Reconstruction, WorkingFrame, leave_working_frame
from poem_jax.typing import Array, Bool, Float, Num, PRNGKeyArray

_CODE_EXPANSION = 4
"""Hidden channels of the networks that mix position codes, over the width of the tokens."""


class ViewMaps(NamedTuple):
    """What is computed of every view alone; leading axes (image,) or (batch, view)."""

    maps: Float[Array, "*batch h w c"]


class Tokens(NamedTuple):
    """Cells of the maps of all views, (view, row, column) flattened."""

    values: Float[Array, "batch token c"]
    codes: Float[Array, "batch token c"] | None
    """Added where keys are made; None = the values hold them."""
    mask: Bool[Array, "batch token"]
    """False where the view is not valid."""


class Queries(NamedTuple):
    """What the decoder starts from, the same for every sample."""

    codes: Float[Array, "query c"]
    start: Float[Array, "query 3"]
    """Shares of the cuboid."""


class MeshTransformer(nnx.Module):
    """PE-MeshTR or FTL-MeshTR, by `config.fusion`."""

    def __init__(self, config: MeshTransformerConfig, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.config = config
        by_paper = config.design is Design.PAPER
        self.trunk = ResNet(config.backbone, rngs=rngs)
        self.features = (BranchFeatures if by_paper else CoarsestFeatures)(config, rngs=rngs)
        self.fusion = _FUSIONS[type(config.fusion), config.design](config, rngs=rngs)
        self.queries = (EmbeddedQueries if by_paper else ReferenceQueries)(config, rngs=rngs)
        self.decoder = DetrDecoder(config.decoder, config.width, rngs=rngs)
        self.offsets = ReadOutNetwork(config.width, rngs=rngs)
        self.hand = HandConstants(hand)

    def look(
        self, views: Num[Array, "*batch h w 3"], mode: NormMode, settled: NormMode | None = None
    ) -> ViewMaps:
        """Do what is done with every view alone: trunk and feature map; any leading axes."""
        images = trunk_images(views, self.config, self.hand.model().v_template.dtype)
        levels = self.trunk(images, mode if settled is None else settled)
        maps = self.features(levels, mode)
        return ViewMaps(maps.reshape(*views.shape[:-3], *maps.shape[1:]))

    def find_hands(
        self,
        seen: ViewMaps,
        frame: WorkingFrame,
        mode: NormMode,
        *,
        dropout_key: PRNGKeyArray | None = None,
    ) -> Prediction:
        """Join what was seen in the views (batch, view) to one hand per sample, in the user's world."""
        cams = frame.cams
        tokens = self.fusion(seen.maps, cams, mode)
        queries = self.queries(self.hand.model())
        codes = jnp.broadcast_to(queries.codes, (len(tokens.values), *queries.codes.shape))
        embeddings = self.decoder(codes, tokens.values, tokens.codes, tokens.mask, dropout_key)
        shares = sigmoid_step(
            jnp.broadcast_to(queries.start, (*embeddings.shape[:-1], 3)), self.offsets(embeddings)
        )
        found = Reconstruction(
            keypoints_px=None,
            heat_maps=None,
            reference_joints=None,
            root=None,
            valid=jnp.any(cams.view_mask, -1),
            layers=denormalised(shares, self.config.cuboid),
            parameters=None,
        )
        return leave_working_frame(found, frame, self.hand.model(), self.config.query_order)


# The map of every view.


class BranchFeatures(nnx.Module):
    """The whole trunk, then back up to the stride, as POEM's features (paper)."""

    def __init__(self, config: MeshTransformerConfig, *, rngs: nnx.Rngs) -> None:
        trunk = config.backbone
        self.branch = TopDownBranch(trunk.channels, trunk.strides, config.stride, rngs=rngs)
        self.project = Conv(self.branch.c_out, config.width, 1, bias=True, rngs=rngs)

    def __call__(self, levels: tuple[Array, ...], mode: NormMode) -> Float[Array, "image h w c"]:
        """Return the feature maps."""
        return self.project(self.branch(levels, mode))


class CoarsestFeatures(nnx.Module):
    """The trunk's last map (release)."""

    def __init__(self, config: MeshTransformerConfig, *, rngs: nnx.Rngs) -> None:
        self.project = Conv(config.backbone.channels[-1], config.width, 1, bias=True, rngs=rngs)

    def __call__(self, levels: tuple[Array, ...], mode: NormMode) -> Float[Array, "image h w c"]:
        """Return the feature maps."""
        return self.project(levels[-1])


# Fusion: from the maps of the views to tokens.


class EmbeddedPositions(nnx.Module):
    """Position-embedded fusion of the paper: B_W = (reshape(B_cam, (W, H, D, C / D)) + f_M(M_W)), flattened.

    M_W is the camera's grid in the primary camera's frame, as shares of the cuboid; f_M are sines
    (`grid_point_code`). Keys and values are B_W. No view has a number: all but the first, whose frame it is,
    may change places.
    """

    def __init__(self, config: MeshTransformerConfig, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.fusion, PositionEmbeddedFusion)
        self.frustum, self.cuboid, self.image_hw = config.fusion.frustum, config.cuboid, config.image_hw

    def __call__(self, maps: Float[Array, "batch view h w c"], cams: Cameras, mode: NormMode) -> Tokens:
        """Return the tokens."""
        h, w, c = maps.shape[-3:]
        grid = jnp.swapaxes(frustum_grid(self.frustum, cams, (h, w), self.image_hw), 2, 3)
        codes = grid_point_code(normalised(grid, self.cuboid), c // self.frustum.num_depths)
        told = maps + codes.reshape(maps.shape).astype(maps.dtype)
        return Tokens(_flattened(told), None, _token_mask(cams.view_mask, h * w))


def grid_point_code(shares: Float[Array, "*batch 3"], width: int) -> Float[Array, "*batch c"]:
    """Encode points, given as shares of their space, by `width` / 2 sines, each followed by its cosine.

    Of waves pi x, pi y, pi z, then of twice the frequencies, and so on, until the channels are full: the
    paper says no more than "a series of sinusoids". The longest wave is twice the space, so that its opposite
    faces differ; frequencies rise, since points of one hand lie within a tenth of it.
    """
    wave = np.arange(width // 2)
    angle = shares[..., wave % 3] * jnp.asarray(np.pi * 2.0 ** (wave // 3), shares.dtype)
    return jnp.stack([jnp.sin(angle), jnp.cos(angle)], -1).reshape(*shares.shape[:-1], width)


class EncodedPositions(nnx.Module):
    """Position-embedded fusion of the release: keys are told the grid behind a cell, and its view, row and
    column; values are not.

    The view's number comes among the sample's valid ones, so that views may not change places.
    """

    def __init__(self, config: MeshTransformerConfig, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.fusion, PositionEmbeddedFusion)
        self.frustum, self.cuboid, self.image_hw = config.fusion.frustum, config.cuboid, config.image_hw
        self.grid_code = PointwiseNetwork(3 * self.frustum.num_depths, config.width, rngs=rngs)
        self.place_code = PlaceCode(config.width, rngs=rngs)

    def __call__(self, maps: Float[Array, "batch view h w c"], cams: Cameras, mode: NormMode) -> Tokens:
        """Return the tokens."""
        h, w = maps.shape[-3:-1]
        grid = frustum_channels(frustum_grid(self.frustum, cams, (h, w), self.image_hw), self.cuboid)
        codes = self.grid_code(grid) + self.place_code(cams.view_mask, (h, w))
        return Tokens(_flattened(maps), _flattened(codes), _token_mask(cams.view_mask, h * w))


class CanonicalMaps(nnx.Module):
    """Canonical fusion of the paper: B_W = (T^-1 reshape(B_cam, (W, H, C / 3, 3))), flattened; all views,
    concatenated, go through one convolution, which gives each a map again. B_cam has 3 numbers a point, from
    the map by a linear layer alone: a coordinate may have either sign, as where T^-1 takes it.

    Its weights belong to a first, second, ... view: up to `num_views` may be valid, and they may not change
    places. Views that are not valid are taken for none.
    """

    def __init__(self, config: MeshTransformerConfig, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.fusion, CanonicalFusion)
        self.num_views, self.width = config.fusion.num_views, config.width
        channels = 3 * config.fusion.num_points
        self.to_points = Conv(self.width, channels, 1, bias=True, rngs=rngs)
        self.fuse = Conv(self.num_views * channels, self.num_views * self.width, 1, bias=True, rngs=rngs)
        self.place_code = PlaceCode(self.width, rngs=rngs)

    def __call__(self, maps: Float[Array, "batch view h w c"], cams: Cameras, mode: NormMode) -> Tokens:
        """Return the tokens; `config.view_range` says how many views there may be."""
        batch, view, h, w, _ = maps.shape
        points = self.to_points(maps.reshape(-1, h, w, self.width)).reshape(batch, view, -1, 3)
        moved = transform_points(invert_rigid(cams.T_cam_from_world), points).reshape(batch, view, h, w, -1)
        canonical, cams = valid_views_first(moved, cams)
        canonical = jnp.where(cams.view_mask[..., None, None, None], canonical, 0)
        fused = jnp.moveaxis(self._fused(jnp.moveaxis(canonical, 1, 3)), 3, 1)
        codes = self.place_code(cams.view_mask, (h, w))
        return Tokens(_flattened(fused), _flattened(codes), _token_mask(cams.view_mask, h * w))

    def _fused(self, points: Float[Array, "batch h w view c"]) -> Float[Array, "batch h w view c2"]:
        """Convolve what is there; further views would add nothing and be read by nobody."""
        view, channels = points.shape[-2:]
        assert self.fuse.bias is not None
        kernel = self.fuse.kernel[...].reshape(self.num_views, channels, self.num_views, self.width)
        kernel = kernel[:view, :, :view].reshape(view * channels, view * self.width)
        flat = points.reshape(*points.shape[:-2], -1).astype(kernel.dtype)
        fused = flat @ kernel + self.fuse.bias[: view * self.width]
        return fused.reshape(*fused.shape[:-1], view, self.width)


class PixelUnitMaps(nnx.Module):
    """Canonical fusion of the release, view by view: a convolution; points by K^-1 T^-1; a convolution;
    points by K T, into pixel units of the same camera, undivided by depth; a convolution.

    T^-1 goes from the camera to the primary one. Nothing of another view enters before the decoder. Keys are
    told view, row and column, as in `EncodedPositions`.
    """

    def __init__(self, config: MeshTransformerConfig, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.fusion, CanonicalFusion)
        width, channels = config.width, 3 * config.fusion.num_points
        self.to_points = ConvNorm(width, channels, 1, bias=True, rngs=rngs)
        self.between = ConvNorm(channels, channels, 1, bias=True, rngs=rngs)
        self.from_points = ConvNorm(channels, width, 1, bias=True, relu=False, rngs=rngs)
        self.place_code = PlaceCode(width, rngs=rngs)

    def __call__(self, maps: Float[Array, "batch view h w c"], cams: Cameras, mode: NormMode) -> Tokens:
        """Return the tokens."""
        K, T = cams.K, cams.T_cam_from_world
        points = _per_image(self.to_points, maps, mode)
        points = _mapped(matmul(invert_intrinsics(K), invert_rigid(T)[..., :3, :]), points)
        points = _per_image(self.between, points, mode)
        points = _mapped(matmul(K, T[..., :3, :]), points)
        values = _per_image(self.from_points, points, mode)
        h, w = maps.shape[-3:-1]
        codes = self.place_code(cams.view_mask, (h, w))
        return Tokens(_flattened(values), _flattened(codes), _token_mask(cams.view_mask, h * w))


_FUSIONS = {
    (PositionEmbeddedFusion, Design.PAPER): EmbeddedPositions,
    (PositionEmbeddedFusion, Design.RELEASE): EncodedPositions,
    (CanonicalFusion, Design.PAPER): CanonicalMaps,
    (CanonicalFusion, Design.RELEASE): PixelUnitMaps,
}


class PlaceCode(nnx.Module):
    """Sines of view, row and column, mixed to the width of the tokens by a network."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.axis_width = width // 2
        self.mix = PointwiseNetwork(3 * self.axis_width, width, rngs=rngs)

    def __call__(
        self, view_mask: Bool[Array, "batch view"], map_hw: tuple[int, int]
    ) -> Float[Array, "batch view h w c"]:
        """Return the codes; those of masked views mean nothing."""
        kernel = self.mix.hidden.kernel[...]
        return self.mix(view_row_column_code(view_mask, map_hw, self.axis_width).astype(kernel.dtype))


class PointwiseNetwork(nnx.Module):
    """Two layers, cell by cell."""

    def __init__(self, c_in: int, width: int, *, rngs: nnx.Rngs) -> None:
        hidden = _CODE_EXPANSION * width
        self.hidden = Conv(c_in, hidden, 1, bias=True, rngs=rngs)
        self.out = Conv(hidden, width, 1, bias=True, rngs=rngs)

    def __call__(self, x: Float[Array, "batch view h w c"]) -> Float[Array, "batch view h w c2"]:
        """Apply."""
        y = self.out(jax.nn.relu(self.hidden(x.reshape(-1, *x.shape[2:]))))
        return y.reshape(*x.shape[:2], *y.shape[1:])


def _per_image(
    layer: ConvNorm, maps: Float[Array, "batch view h w c"], mode: NormMode
) -> Float[Array, "batch view h w c2"]:
    y = layer(maps.reshape(-1, *maps.shape[2:]), mode)
    return y.reshape(*maps.shape[:2], *y.shape[1:])


def _mapped(
    A: Float[Array, "batch view 3 4"], maps: Float[Array, "batch view h w c"]
) -> Float[Array, "batch view h w c"]:
    """Map the points of every cell, whose channels are all x, all y, all z, by A [x, y, z, 1]."""
    batch, view, h, w, c = maps.shape
    points = jnp.moveaxis(maps.reshape(batch, view, h * w, 3, c // 3), 3, 2).reshape(batch, view, 3, -1)
    mapped = (matmul(A[..., :3], points) + A[..., 3:]).reshape(batch, view, 3, h * w, c // 3)
    return jnp.moveaxis(mapped, 2, 3).reshape(maps.shape)


def _flattened(maps: Float[Array, "batch view h w c"]) -> Float[Array, "batch token c"]:
    return maps.reshape(len(maps), -1, maps.shape[-1])


def _token_mask(view_mask: Bool[Array, "batch view"], cells: int) -> Bool[Array, "batch token"]:
    return jnp.repeat(jnp.asarray(view_mask), cells, 1)


# Queries, and what becomes of them.


class EmbeddedQueries(nnx.Module):
    """A learned embedding of each query, `E_X` (paper, section "Learnable Query Points")."""

    def __init__(self, config: MeshTransformerConfig, *, rngs: nnx.Rngs) -> None:
        self.embeddings = PerQuery(normal(rngs.params(), (NUM_QUERIES, config.width)))

    def __call__(self, hand: HandModel) -> Queries:
        """Return the embeddings, and the middle of the cuboid."""
        codes = self.embeddings[...]
        return Queries(codes, jnp.full((NUM_QUERIES, 3), 0.5, hand.v_template.dtype))


class ReferenceQueries(nnx.Module):
    """Learned points; what tells queries apart are the points' sines, and for PE-MeshTR the hand template
    about its wrist, mixed by a network (release)."""

    def __init__(self, config: MeshTransformerConfig, *, rngs: nnx.Rngs) -> None:
        self.axis_width, self.order = config.width // 2, config.query_order
        self.with_template = isinstance(config.fusion, PositionEmbeddedFusion)
        self.points = Exact(uniform(rngs.params(), (NUM_QUERIES, 3)))
        numbers = 3 * self.axis_width + (3 if self.with_template else 0)
        self.hidden = linear(numbers, config.width, rngs=rngs)
        self.out = linear(config.width, config.width, rngs=rngs)

    def __call__(self, hand: HandModel) -> Queries:
        """Return the codes of the points as they are, and the points through a sigmoid."""
        points = self.points[...]
        code = point_sine_code(points, self.axis_width)
        if self.with_template:
            code = jnp.concatenate([code, template_queries(hand, self.order, center_joint=WRIST)], -1)
        return Queries(self.out(jax.nn.relu(self.hidden(code))), jax.nn.sigmoid(points))


class ReadOutNetwork(nnx.Module):
    """Three layers from embedding to the logits' offset, the same after every decoder layer."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.hidden = nnx.List(linear(width, width, rngs=rngs) for _ in range(2))
        self.out = linear(width, 3, exact=True, rngs=rngs)

    def __call__(self, embeddings: Float[Array, "*batch c"]) -> Float[Array, "*batch 3"]:
        """Regress."""
        for layer in self.hidden:
            embeddings = jax.nn.relu(layer(embeddings))
        return self.out(embeddings)
