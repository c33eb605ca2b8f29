"""POEM v1's first stage: where the query points and the ball of basis points begin; and the coordinates in
which the second works.

All 21 joints are triangulated and initialise the vertices (paper, "Output of the First Stage"); the ablation
of one stage learns where to begin instead.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES, NUM_VERTICES, ROOT_JOINT, WRIST, join_queries
from poem_jax.models.config import RootConfig
from poem_jax.models.frustum import denormalised, normalised, sigmoid_step
from poem_jax.models.frustum_config import Cuboid
from poem_jax.models.heat_maps import root_point, triangulate_joints
from poem_jax.models.layers import Exact, linear, uniform
from poem_jax.models.poem_v1_config import OneStageConfig, PoemV1Config
from poem_jax.models.world_frame import WorkingFrame
from poem_jax.typing import Array, Bool, Float, Int, PRNGKeyArray

_SHIFT_SCALE = 0.01
"""Metres. What the release's layer that moves the ball is multiplied by."""


class ViewFeatures(NamedTuple):
    """What is computed of every view alone; leading axes (image,) or (batch, view)."""

    keypoints_px: Float[Array, "*batch joint 2"] | None
    """None without a first stage."""
    heat_maps: Float[Array, "*batch joint h w"] | None
    feature_maps: Float[Array, "*batch h w c"]
    pooled: Float[Array, "*batch c2"]
    """Mean of the trunk's coarsest map."""


class Start(NamedTuple):
    """Where the second stage begins, in the primary camera's frame, metres; all finite."""

    queries: Float[Array, "batch query 3"]
    centre: Float[Array, "batch 3"]
    """Of the ball."""
    root: Float[Array, "batch 3"] | None
    """None where there is no first stage."""
    joints: Float[Array, "batch 21 3"] | None
    """As triangulated; what stands where they could not be means nothing."""
    solved: Bool[Array, "batch 21"] | None
    """Which could be."""
    valid: Bool[Array, " batch"]


class Scene(NamedTuple):
    """What the second stage works with, in the primary camera's frame, metres."""

    feature_maps: Float[Array, "batch view h w c"]
    pooled: Float[Array, "batch view c2"]
    """Mean of the trunk's coarsest map, of every view."""
    cams: Cameras
    grid: Float[Array, "batch view w h depth 3"]
    """Frustum grids of the feature maps' cells."""
    index: Int[Array, "batch basis"] | None
    """Numbers of the basis points in the grid, flattened; -1 = the ball held no more. None = no basis."""
    start: Start
    dropout_key: PRNGKeyArray | None
    """For what is dropped in training."""


# First stage: joints, and the query points that they start as.


class LinearMesh(nnx.Module):
    """The 778 vertices as weighted sums of the 21 joints, the same weights for x, y and z; at first their
    mean."""

    def __init__(self) -> None:
        self.kernel = Exact(jnp.asarray(np.full((NUM_JOINTS, NUM_VERTICES), 1 / NUM_JOINTS, np.float32)))
        self.bias = Exact(jnp.asarray(np.zeros(NUM_VERTICES, np.float32)))

    def __call__(self, joints: Float[Array, "batch 21 3"]) -> Float[Array, "batch 778 3"]:
        """Return vertices about the point that the joints are about."""
        kernel = self.kernel[...]
        return jnp.einsum("jv,bjx->bvx", kernel, joints, precision="highest") + self.bias[...][:, None]


class TriangulatedStart(nnx.Module):
    """All joints triangulated; vertices by `LinearMesh` about the root, joint 9, where the ball is
    (paper)."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.first_stage, RootConfig)
        self.config, self.order, self.mesh = config.first_stage, config.query_order, LinearMesh()

    def __call__(self, seen: ViewFeatures, frame: WorkingFrame) -> Start:
        """Return where the second stage begins; joints that could not be triangulated start at the root."""
        assert seen.keypoints_px is not None
        assert seen.heat_maps is not None
        cams = frame.cams
        joints, solved = triangulate_joints(self.config, seen.keypoints_px, seen.heat_maps, cams)
        root, valid = root_point(joints, solved, frame.known_root, jnp.asarray(cams.view_mask))
        about_root = jnp.where(solved[..., None], joints - root[:, None], 0)
        queries = join_queries(self.mesh(about_root), about_root, self.order) + root[:, None]
        return Start(queries, root, root, joints, solved, valid)


class ReleaseStart(nnx.Module):
    """All joints triangulated; vertices by `LinearMesh` about the wrist. The ball is about the mean of the
    query points, moved by a layer that no gradient reaches."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.first_stage, RootConfig)
        self.config, self.order, self.mesh = config.first_stage, config.query_order, LinearMesh()
        self.shift_hidden = linear(NUM_QUERIES, NUM_QUERIES, exact=True, rngs=rngs)
        self.shift = linear(NUM_QUERIES, 1, exact=True, rngs=rngs)

    def __call__(self, seen: ViewFeatures, frame: WorkingFrame) -> Start:
        """Return where the second stage begins; samples with a joint that was not solved mean nothing."""
        assert seen.keypoints_px is not None
        assert seen.heat_maps is not None
        joints, solved = triangulate_joints(self.config, seen.keypoints_px, seen.heat_maps, frame.cams)
        wrist = joints[:, WRIST, None]
        about_wrist = joints - wrist
        queries = join_queries(self.mesh(about_wrist), about_wrist, self.order) + wrist
        root, centre = joints[:, ROOT_JOINT], self._centre(queries)
        return Start(queries, centre, root, joints, solved, jnp.all(solved, -1))

    def _centre(self, queries: Float[Array, "batch query 3"]) -> Float[Array, "batch 3"]:
        by_axis = jnp.swapaxes(queries, 1, 2)
        shift = self.shift(jax.nn.relu(self.shift_hidden(by_axis)))[..., 0]
        return jnp.mean(queries, 1) + _SHIFT_SCALE * shift


class LearnedStart(nnx.Module):
    """No first stage: learned query points, shares of the cuboid; the ball is about a fixed point."""

    def __init__(self, config: PoemV1Config, *, rngs: nnx.Rngs) -> None:
        assert isinstance(config.first_stage, OneStageConfig)
        assert isinstance(config.space, Cuboid)
        self.cuboid, self.origin = config.space, config.first_stage.origin
        self.points = Exact(uniform(rngs.params(), (NUM_QUERIES, 3)))

    def __call__(self, seen: ViewFeatures, frame: WorkingFrame) -> Start:
        """Return the same for every sample."""
        points = denormalised(self.points[...], self.cuboid)
        batch = len(frame.cams.view_mask)
        queries, centre = (
            jnp.broadcast_to(jnp.asarray(leaf, points.dtype), (batch, *np.shape(leaf)))
            for leaf in (points, np.array(self.origin))
        )
        return Start(queries, centre, None, None, None, jnp.ones(batch, bool))


# Coordinates in which the second stage works.


Move = Callable[[Float[Array, "batch query 3"], Float[Array, "batch query 3"]], Float[Array, "batch query 3"]]
"""From points and offsets to the moved points."""


class AboutRoot(NamedTuple):
    """Coordinates about the root, in units of the ball's radius."""

    root: Float[Array, "batch 3"]
    radius: float

    def enter(self, points: Float[Array, "batch point 3"]) -> Float[Array, "batch point 3"]:
        """From metres."""
        return (points - self.root[:, None]) / self.radius

    def leave(self, points: Float[Array, "batch point 3"]) -> Float[Array, "batch point 3"]:
        """To metres."""
        return points * self.radius + self.root[:, None]

    def move(
        self, points: Float[Array, "batch point 3"], offset: Float[Array, "batch point 3"]
    ) -> Float[Array, "batch point 3"]:
        """X + FFN(E)."""
        return points + offset


class InCuboid(NamedTuple):
    """Coordinates that are shares of a cuboid, which no point leaves."""

    cuboid: Cuboid

    def enter(self, points: Float[Array, "batch point 3"]) -> Float[Array, "batch point 3"]:
        """From metres."""
        return normalised(points, self.cuboid)

    def leave(self, points: Float[Array, "batch point 3"]) -> Float[Array, "batch point 3"]:
        """To metres."""
        return denormalised(points, self.cuboid)

    def move(
        self, points: Float[Array, "batch point 3"], offset: Float[Array, "batch point 3"]
    ) -> Float[Array, "batch point 3"]:
        """Add the offset to the logits of the shares."""
        return sigmoid_step(points, offset)


def space_of(config: PoemV1Config, root: Float[Array, "batch 3"] | None) -> AboutRoot | InCuboid:
    """Return the coordinates that a config's second stage works in."""
    if isinstance(config.space, Cuboid):
        return InCuboid(config.space)
    assert root is not None
    return AboutRoot(root, config.basis.radius)
