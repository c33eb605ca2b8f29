"""The POEM v2 network as one module, working in the primary camera's frame."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.geometry.cameras import Cameras, primary_view, project
from poem_jax.geometry.triangulation import triangulate
from poem_jax.hand.model import HandModel, hand_mesh
from poem_jax.hand.topology import (
    NUM_JOINTS,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    ROOT_JOINT,
    join_vertices_first,
    split_vertices_first,
)
from poem_jax.models.aggregation import ProjectiveAggregation
from poem_jax.models.basis import basis_points, projected_features
from poem_jax.models.batch_norm import NormMode
from poem_jax.models.config import Config, DecoderOutput, HRNetConfig, QueryStart, ViewWeights
from poem_jax.models.convolution import Conv
from poem_jax.models.decoder import Decoder
from poem_jax.models.hrnet import HRNet
from poem_jax.models.parametric import HandParameters, ParameterRegressor, root_relative_mesh
from poem_jax.models.pyramid import TopDownBranch
from poem_jax.models.query_start import pose_by_joints
from poem_jax.models.resnet import ResNet
from poem_jax.models.root import HeatMapBranch, spread
from poem_jax.typing import Array, Bool, Float

_FALLBACK_ROOT = (0.0, 0.0, 0.5)
"""Where the second stage works for samples without a root: in front of the primary camera, all finite."""
_FARTHEST_JOINT = 1.5
"""Basis radii. Triangulated joints farther from the root are drawn in before they pose the template."""


_SHARPEST_MAP = 0.25
"""Cells squared. Narrower heat maps weigh no more than this in the triangulation."""


class Constant(nnx.Variable):
    """An array that is stored with the weights and never trained."""


class Reconstruction(NamedTuple):
    """The network's output in the primary camera's frame, metres."""

    keypoints_px: Float[Array, "batch view joint 2"]
    heat_maps: Float[Array, "batch view joint h w"]
    reference_joints: Float[Array, "batch joint 3"]
    """Triangulated key points; zero where they could not be."""
    root: Float[Array, "batch 3"]
    valid: Bool[Array, " batch"]
    layers: Float[Array, "layer batch query 3"]
    """Query points [vertices, joints] after every layer."""
    parameters: HandParameters | None


class HandConstants(nnx.Module):
    """The hand model's arrays, stored with the weights."""

    def __init__(self, hand: HandModel) -> None:
        for name, value in hand._asdict().items():
            setattr(self, name, Constant(jnp.asarray(value)))

    def model(self) -> HandModel:
        """Return them as a `HandModel`."""
        return HandModel(*(getattr(self, name)[...] for name in HandModel._fields))


class FeatureBranch(nnx.Module):
    """Image features for the basis points: the heat-map branch's design with its own weights."""

    def __init__(self, config: Config, *, rngs: nnx.Rngs) -> None:
        trunk = config.backbone
        self.branch = TopDownBranch(trunk.channels, trunk.strides, config.feature_stride, rngs=rngs)
        self.project = Conv(self.branch.c_out, config.width, 1, bias=True, rngs=rngs)

    def __call__(self, levels: tuple[Array, ...], mode: NormMode) -> Float[Array, "image h w c"]:
        """Return the feature map."""
        return self.project(self.branch(levels, mode))


class Poem(nnx.Module):
    """POEM v2 (paper, figure "Model architecture")."""

    def __init__(self, config: Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.config = config
        trunk = config.backbone
        self.trunk = (HRNet if isinstance(trunk, HRNetConfig) else ResNet)(trunk, rngs=rngs)  # pyright: ignore[reportArgumentType]
        self.heat_maps = HeatMapBranch(config.root, trunk, rngs=rngs)
        self.features = FeatureBranch(config, rngs=rngs)
        self.aggregation = ProjectiveAggregation(config.width, config.similarity, rngs=rngs)
        self.decoder = Decoder(config.decoder, config.width, rngs=rngs)
        parametric = config.decoder.output is DecoderOutput.HAND_PARAMETERS
        self.regressor = ParameterRegressor(config.width, rngs=rngs) if parametric else None
        self.basis_points = Constant(jnp.asarray(basis_points(config.basis)))
        self.template_queries = Constant(jnp.asarray(_template_queries(hand)))
        self.hand = HandConstants(hand)

    def __call__(
        self,
        images: Float[Array, "batch view h w 3"],
        cams: Cameras,
        known_root: Float[Array, "batch 3"] | None,
        mode: NormMode,
    ) -> Reconstruction:
        """Reconstruct in the primary camera's frame; where `known_root` is None or NaN, triangulate it."""
        levels = self.trunk(images.reshape(-1, *images.shape[2:]), mode)
        keypoints_px, heat_maps = (_per_view(x, cams) for x in self.heat_maps(levels, mode))
        reference_joints, solved = self._triangulate(keypoints_px, heat_maps, cams)
        # In training the first stage learns from its own loss alone: rays that nearly coincide would send
        # wild gradients through the triangulation.
        joints = jax.lax.stop_gradient(reference_joints) if mode.training else reference_joints
        root, valid = self._root(joints, solved, cams, known_root)

        basis_features = self._read_views(levels, cams, root, mode)
        radius = self.config.basis.radius
        start = self._start(joints - root[:, None], jnp.all(solved, -1))
        moved, embeddings = self.decoder(start / radius, self.basis_points[...] / radius, basis_features)

        layers, parameters = [radius * queries for queries in moved], None
        if self.regressor is not None:
            parameters = self.regressor(embeddings)
            layers.append(join_vertices_first(*root_relative_mesh(self.hand.model(), parameters)))
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
        joints, solved = triangulate(keypoints_px, cams.K, cams.T_cam_from_world, weights, mask)
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
        self, levels: tuple[Array, ...], cams: Cameras, root: Float[Array, "batch 3"], mode: NormMode
    ) -> Float[Array, "batch basis c"]:
        """Return the features of the basis points about `root`, fused over the views."""
        feature_maps = _per_view(self.features(levels, mode), cams)
        basis = root[:, None] + self.basis_points[...]
        sampled = projected_features(feature_maps, cams, basis, self.config.image_hw)
        return self.aggregation(sampled, cams.view_mask, primary_view(cams.view_mask))

    def _start(self, joints: Array, solved: Array) -> Float[Array, "batch query 3"]:
        """Return the query points before the first layer, metres about the root."""
        template = self.template_queries[...]
        if self.config.decoder.query_start is QueryStart.TEMPLATE:
            return jnp.broadcast_to(template, (joints.shape[0], *template.shape))
        joints = _draw_in(joints, _FARTHEST_JOINT * self.config.basis.radius)
        posed = join_vertices_first(
            pose_by_joints(self.hand.model(), *split_vertices_first(template), joints), joints
        )
        return jnp.where(solved[:, None, None], posed, template)


def _per_view(values: Float[Array, "image *rest"], cams: Cameras) -> Float[Array, "batch view *rest"]:
    return values.reshape(*cams.view_mask.shape, *values.shape[1:])


def _template_queries(hand: HandModel) -> Float[Array, "query 3"]:
    """Return the flat mean hand about its root joint, metres, [vertices, joints]."""
    dtype = hand.v_template.dtype
    zero_pose, mean_shape = np.zeros((NUM_SKELETON_JOINTS, 3), dtype), np.zeros(NUM_SHAPES, dtype)
    return join_vertices_first(*hand_mesh(hand, zero_pose, mean_shape, center_joint=ROOT_JOINT))


def _draw_in(points: Float[Array, "*batch 3"], limit: float) -> Float[Array, "*batch 3"]:
    """Shorten vectors to at most `limit`."""
    square = jnp.sum(points**2, -1, keepdims=True)
    return points * jnp.minimum(1.0, limit * jax.lax.rsqrt(jnp.maximum(square, 1e-12)))
