"""Between the user's world and the primary camera, in whose frame a model works; nothing else converts."""

from typing import NamedTuple

import jax.numpy as jnp

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, anchor_to_primary
from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    invert_rigid,
    matmul,
    transform_points,
)
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import NUM_JOINTS, WRIST, QueryOrder, split_queries
from poem_jax.models.parametric import HandParameters
from poem_jax.models.reconstruction import Reconstruction
from poem_jax.typing import Array, Float


class PrimaryFrame(NamedTuple):
    """Cameras and known roots seen from the primary camera, and the way back."""

    cams: Cameras
    root: Float[Array, "batch 3"] | None
    T_world_from_primary: Float[Array, "batch 4 4"]


def enter_primary_frame(cams: Cameras, root_world: Float[Array, "batch 3"] | None) -> PrimaryFrame:
    """Move cameras and roots to the primary camera; NaN rows of the roots stay NaN."""
    T_cam_from_primary, T_primary_from_world = anchor_to_primary(cams.T_cam_from_world, cams.view_mask)
    root = None
    if root_world is not None:
        root = _move_root(T_primary_from_world, jnp.asarray(root_world, T_cam_from_primary.dtype))
    moved = cams._replace(T_cam_from_world=T_cam_from_primary)
    return PrimaryFrame(moved, root, invert_rigid(T_primary_from_world))


def leave_primary_frame(
    result: Reconstruction,
    T_world_from_primary: Float[Array, "batch 4 4"],
    hand: HandModel,
    order: QueryOrder,
) -> Prediction:
    """Express what the network found in the user's world."""
    layers_world = transform_points(T_world_from_primary, result.layers)
    vertices_world, joints_world = split_queries(layers_world[-1], order)
    has_all_joints = result.reference_joints.shape[1] == NUM_JOINTS
    prediction = Prediction(
        vertices_world=vertices_world,
        joints_world=joints_world,
        root_world=_move(T_world_from_primary, result.root),
        keypoints_px=result.keypoints_px,
        heat_maps=result.heat_maps,
        layers_world=layers_world,
        valid=result.valid,
        reference_joints_world=(
            transform_points(T_world_from_primary, result.reference_joints) if has_all_joints else None
        ),
    )
    if result.parameters is None:
        return prediction
    return _with_parameters(prediction, result.parameters, T_world_from_primary, hand)


def _with_parameters(
    prediction: Prediction, parameters: HandParameters, T_world_from_primary: Array, hand: HandModel
) -> Prediction:
    """Add pose, shape and translation: `hand_mesh` of them gives the vertices in the world."""
    turned = matmul(T_world_from_primary[:, :3, :3], parameters.rotations[:, 0])
    rotations = jnp.concatenate([turned[:, None], parameters.rotations[:, 1:]], 1)
    resting_wrist = hand.shape(parameters.shape).skeleton[:, WRIST]
    return prediction._replace(
        pose=axis_angle_from_rotation(rotations),
        shape=parameters.shape,
        translation=prediction.joints_world[:, WRIST] - resting_wrist,
    )


def _move_root(
    T_a_from_b: Float[Array, "batch 4 4"], root_b: Float[Array, "batch 3"]
) -> Float[Array, "batch 3"]:
    """Move known roots; unknown ones stay NaN, without letting NaN into gradients."""
    known = jnp.all(jnp.isfinite(root_b), -1, keepdims=True)
    return jnp.where(known, _move(T_a_from_b, jnp.where(known, root_b, 0)), jnp.nan)


def _move(
    T_a_from_b: Float[Array, "batch 4 4"], points_b: Float[Array, "batch 3"]
) -> Float[Array, "batch 3"]:
    return transform_points(T_a_from_b, points_b[:, None])[:, 0]
