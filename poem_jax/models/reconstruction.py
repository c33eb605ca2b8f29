"""The POEM v2 network as one module, working in the primary camera's frame."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.geometry.cameras import Cameras, primary_view, project
from poem_jax.geometry.neighbours import farthest_points
from poem_jax.geometry.triangulation import triangulate
from poem_jax.hand.model import HandModel, hand_mesh
from poem_jax.hand.topology import (
    NUM_JOINTS,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    ROOT_JOINT,
    QueryOrder,
    join_queries,
    split_queries,
)
from poem_jax.models.aggregation import ProjectiveAggregation
from poem_jax.models.basis import basis_points, projected_features
from poem_jax.models.batch_norm import NormMode
from poem_jax.models.config import (
    Config,
    DecoderOutput,
    FeatureFusion,
    FirstNeighbours,
    HRNetConfig,
    Layout,
    PositionCode,
    QueryStart,
    ViewWeights,
)
from poem_jax.models.convolution import Conv
from poem_jax.models.decoder import Anchors, Decoder, Surroundings, around_anchors
from poem_jax.models.hrnet import HRNet
from poem_jax.models.parametric import HandParameters, ParameterRegressor, root_relative_mesh
from poem_jax.models.position_code import ViewRowColumnCode, sine_code
from poem_jax.models.pyramid import BottomUpBranch, TopDownBranch
from poem_jax.models.query_start import pose_by_joints
from poem_jax.models.resnet import ResNet
from poem_jax.models.root import HeatMapBranch, spread
from poem_jax.typing import Array, Bool, Float, PRNGKeyArray

_FALLBACK_ROOT = (0.0, 0.0, 0.5)
"""Where the second stage works for samples without a root: in front of the primary camera, all finite."""
_FARTHEST_JOINT = 1.5
"""Basis radii. Triangulated joints farther from the root are drawn in before they pose the template."""


_SHARPEST_MAP = 0.25
"""Cells squared. Narrower heat maps weigh no more than this in the triangulation."""


class Constant(nnx.Variable):
    """An array that is stored with the weights and never trained."""


class ViewFeatures(NamedTuple):
    """What is computed of every view alone; leading axes (image,) or (batch, view)."""

    keypoints_px: Float[Array, "*batch joint 2"]
    heat_maps: Float[Array, "*batch joint h w"]
    feature_maps: Float[Array, "*batch h w c"]
    """Without the position code of `PositionCode.VIEW_ROW_COLUMN`, which depends on the other views."""


class Reconstruction(NamedTuple):
    """The network's output in the primary camera's frame, metres."""

    keypoints_px: Float[Array, "batch view joint 2"]
    heat_maps: Float[Array, "batch view joint h w"]
    reference_joints: Float[Array, "batch joint 3"]
    """Triangulated key points; zero where they could not be."""
    root: Float[Array, "batch 3"]
    valid: Bool[Array, " batch"]
    layers: Float[Array, "layer batch query 3"]
    """Query points after every layer, in the order of the config."""
    parameters: HandParameters | None


class HandConstants(nnx.Module):
    """The hand model's arrays, stored with the weights."""

    def __init__(self, hand: HandModel) -> None:
        for name, value in hand._asdict().items():
            setattr(self, name, Constant(jnp.asarray(value)))

    def model(self) -> HandModel:
        """Return them as a `HandModel`."""
        return HandModel(*(getattr(self, name)[...] for name in HandModel._fields))


class AnchorConstants(nnx.Module):
    """The rows that every query reads in the first layer, and their positions in basis radii.

    They spread over the template: each is the point farthest from those before it, from point 0 on.
    """

    def __init__(self, config: Config, template: Float[np.ndarray, "799 3"]) -> None:
        index = farthest_points(template, config.decoder.num_neighbours)
        self.index = Constant(jnp.asarray(index))
        self.positions = Constant(jnp.asarray(template[index] / config.basis.radius, jnp.float32))

    def values(self) -> Anchors:
        """Return them."""
        return Anchors(self.index[...], self.positions[...])


class FeatureBranch(nnx.Module):
    """Image features for the basis points, on a map of `config.features.stride`."""

    def __init__(self, config: Config, *, rngs: nnx.Rngs) -> None:
        trunk, bias, features = config.backbone, config.branch_bias, config.features
        if features.fusion is FeatureFusion.TOP_DOWN:
            self.branch = TopDownBranch(trunk.channels, trunk.strides, features.stride, bias=bias, rngs=rngs)
        else:
            self.branch = BottomUpBranch(trunk.channels, bias=bias, rngs=rngs)
        self.project = Conv(self.branch.c_out, config.width, 1, bias=True, rngs=rngs)
        on_map = features.position_code is PositionCode.VIEW_ROW_COLUMN
        self.position = ViewRowColumnCode(config.width, rngs=rngs) if on_map else None

    def __call__(self, levels: tuple[Array, ...], mode: NormMode) -> Float[Array, "image h w c"]:
        """Return the feature maps."""
        return self.project(self.branch(levels, mode))

    def with_position(
        self, maps: Float[Array, "batch view h w c"], view_mask: Bool[Array, "batch view"]
    ) -> Float[Array, "batch view h w c"]:
        """Add the position code, if it belongs to the map."""
        return maps if self.position is None else maps + self.position(view_mask, maps.shape[2:4])


class Poem(nnx.Module):
    """POEM v2 (paper, figure "Model architecture")."""

    def __init__(self, config: Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.config = config
        trunk = config.backbone
        self.trunk = (HRNet if isinstance(trunk, HRNetConfig) else ResNet)(trunk, rngs=rngs)  # pyright: ignore[reportArgumentType]
        self.heat_maps = HeatMapBranch(config.root, trunk, bias=config.branch_bias, rngs=rngs)
        self.features = FeatureBranch(config, rngs=rngs)
        self.aggregation = ProjectiveAggregation(config.aggregation, config.width, rngs=rngs)
        self.decoder = Decoder(config.decoder, config.width, rngs=rngs)
        parametric = config.decoder.output is DecoderOutput.HAND_PARAMETERS
        self.regressor = (
            ParameterRegressor(config.width, config.decoder.pooling, rngs=rngs) if parametric else None
        )
        self.basis_points = Constant(jnp.asarray(basis_points(config.basis)))
        template = template_queries(hand, config.decoder.query_order)
        self.template_queries = Constant(jnp.asarray(template))
        anchored = config.decoder.first_neighbours is FirstNeighbours.ANCHORS
        self.anchors = AnchorConstants(config, template) if anchored else None
        self.hand = HandConstants(hand)

    def __call__(
        self,
        images: Float[Array, "batch view h w 3"],
        cams: Cameras,
        known_root: Float[Array, "batch 3"] | None,
        mode: NormMode,
        dropout_key: PRNGKeyArray | None = None,
    ) -> Reconstruction:
        """Reconstruct in the primary camera's frame; where `known_root` is None or NaN, triangulate it."""
        seen = self.look(images.reshape(-1, *images.shape[2:]), mode)
        seen = ViewFeatures(*(leaf.reshape(*cams.view_mask.shape, *leaf.shape[1:]) for leaf in seen))
        return self.reconstruct(seen, cams, known_root, mode, self.first_surroundings(), dropout_key)

    def look(self, images: Float[Array, "image h w 3"], mode: NormMode) -> ViewFeatures:
        """Do what is done with every view alone: trunk, heat maps and feature map."""
        levels = self.trunk(images, mode)
        return ViewFeatures(*self.heat_maps(levels, mode), self.features(levels, mode))

    def first_surroundings(self) -> Surroundings | None:
        """Return whom the first decoder layer reads (batch 1), None where that depends on the sample."""
        return None if self.anchors is None else around_anchors(self.anchors.values())

    def prepared_surroundings(self) -> Surroundings | None:
        """Return the same with all that is constant in it computed."""
        first = self.first_surroundings()
        if first is None or self.config.decoder.query_start is not QueryStart.TEMPLATE:
            return first
        start = self.template_queries[...] / self.config.basis.radius
        return self.decoder.with_first_deltas(start[None], first)

    def reconstruct(
        self,
        seen: ViewFeatures,
        cams: Cameras,
        known_root: Float[Array, "batch 3"] | None,
        mode: NormMode,
        first: Surroundings | None = None,
        dropout_key: PRNGKeyArray | None = None,
    ) -> Reconstruction:
        """Join what was seen in the views (batch, view)."""
        keypoints_px, heat_maps, feature_maps = seen
        reference_joints, solved = self._triangulate(keypoints_px, heat_maps, cams)
        # In training the first stage learns from its own loss alone: rays that nearly coincide would send
        # wild gradients through the triangulation.
        joints = jax.lax.stop_gradient(reference_joints) if mode.training else reference_joints
        root, valid = self._root(joints, solved, cams, known_root)

        basis_features = self._read_views(feature_maps, cams, root)
        radius = self.config.basis.radius
        start = self._start(joints - root[:, None], jnp.all(solved, -1))
        moved, embeddings = self.decoder(
            start / radius,
            self.basis_points[...] / radius,
            basis_features,
            first,
            dropout_key,
        )

        layers, parameters = [radius * queries for queries in moved], None
        if self.regressor is not None:
            parameters = self.regressor(embeddings)
            mesh = root_relative_mesh(self.hand.model(), parameters)
            layers.append(join_queries(*mesh, self.config.decoder.query_order))
        return Reconstruction(
            keypoints_px,
            heat_maps,
            reference_joints,
            root,
            valid,
            jnp.stack(layers) + root[:, None],
            parameters,
        )

    def _triangulate(
        self,
        keypoints_px: Float[Array, "batch view joint 2"],
        heat_maps: Float[Array, "batch view joint h w"],
        cams: Cameras,
    ) -> tuple[Float[Array, "batch joint 3"], Bool[Array, "batch joint"]]:
        """Lift the joints to 3D; one that comes to lie behind a camera that sees it is not solved."""
        weights = None
        if self.config.root.view_weights is ViewWeights.HEAT_SPREAD:
            weights = 1 / jnp.maximum(spread(heat_maps), _SHARPEST_MAP)
        mask = jnp.broadcast_to(cams.view_mask[..., None], keypoints_px.shape[:-1])
        joints, solved = triangulate(
            keypoints_px,
            cams.K,
            cams.T_cam_from_world,
            weights,
            mask,
            normalise_rows=self.config.root.unit_rows,
        )
        _, depth = project(cams.K, cams.T_cam_from_world, joints[:, None])
        return joints, solved & jnp.all((depth > 0) | ~mask, 1)

    def _root(
        self, joints: Array, solved: Array, cams: Cameras, known: Array | None
    ) -> tuple[Float[Array, "batch 3"], Bool[Array, " batch"]]:
        """Return the point about which the second stage works, and whether there is one."""
        index = ROOT_JOINT if self.config.root.num_joints == NUM_JOINTS else 0
        root, valid = joints[:, index], solved[:, index]
        if known is not None:
            given = jnp.all(jnp.isfinite(known), -1)
            root, valid = jnp.where(given[:, None], known, root), given | valid
        valid = valid & jnp.any(cams.view_mask, -1)
        return jnp.where(valid[:, None], root, jnp.array(_FALLBACK_ROOT, root.dtype)), valid

    def _read_views(
        self, feature_maps: Float[Array, "batch view h w c"], cams: Cameras, root: Float[Array, "batch 3"]
    ) -> Float[Array, "batch basis c"]:
        """Return the features of the basis points about `root`, fused over the views."""
        feature_maps = self.features.with_position(feature_maps, cams.view_mask)
        if self.config.aggregation.layout is Layout.ROW_MAJOR:
            feature_maps, cams = _valid_first(feature_maps, cams)
        basis = root[:, None] + self.basis_points[...]
        sampled, uv_share = projected_features(
            feature_maps, cams, basis, self.config.image_hw, self.config.basis.behind_camera
        )
        if self.config.features.position_code is PositionCode.PROJECTED_POINT:
            sampled = sampled + sine_code(uv_share, sampled.shape[-1])
        return self.aggregation(sampled, cams.view_mask, primary_view(cams.view_mask))

    def _start(self, joints: Array, solved: Array) -> Float[Array, "batch query 3"]:
        """Return the query points before the first layer, metres about the root."""
        template, order = self.template_queries[...], self.config.decoder.query_order
        if self.config.decoder.query_start is QueryStart.TEMPLATE:
            return jnp.broadcast_to(template, (joints.shape[0], *template.shape))
        joints = _draw_in(joints, _FARTHEST_JOINT * self.config.basis.radius)
        posed = join_queries(
            pose_by_joints(self.hand.model(), *split_queries(template, order), joints), joints, order
        )
        return jnp.where(solved[:, None, None], posed, template)


def _valid_first(
    maps: Float[Array, "batch view h w c"], cams: Cameras
) -> tuple[Float[Array, "batch view h w c"], Cameras]:
    """Bring the valid views of every sample to the front, in their order."""
    order = jnp.argsort(~cams.view_mask, axis=-1, stable=True)
    take = jax.vmap(lambda values, i: values[i])
    return take(maps, order), Cameras(*(take(leaf, order) for leaf in cams))


def template_queries(hand: HandModel, order: QueryOrder) -> Float[Array, "799 3"]:
    """Return the flat mean hand about its root joint, metres."""
    dtype = hand.v_template.dtype
    zero_pose, mean_shape = np.zeros((NUM_SKELETON_JOINTS, 3), dtype), np.zeros(NUM_SHAPES, dtype)
    return join_queries(*hand_mesh(hand, zero_pose, mean_shape, center_joint=ROOT_JOINT), order)


def _draw_in(points: Float[Array, "*batch 3"], limit: float) -> Float[Array, "*batch 3"]:
    """Shorten vectors to at most `limit`."""
    square = jnp.sum(points**2, -1, keepdims=True)
    return points * jnp.minimum(1.0, limit * jax.lax.rsqrt(jnp.maximum(square, 1e-12)))
