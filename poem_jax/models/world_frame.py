"""Into the frame in which the network works, that of each sample's primary camera, and out of it.

The network computes in float32. A kilometre from the world's origin the extrinsics themselves would lose a
tenth of a millimetre in float32, and their products more. So concrete cameras are moved to the primary camera
in float64, outside JAX, and the last thing that happens to a result is to be moved back.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, anchor_to_primary, fill_masked_views
from poem_jax.geometry.transforms import axis_angle_from_rotation, invert_rigid, matmul, rigid, rotate_points
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import NUM_JOINTS, WRIST, QueryOrder, split_queries
from poem_jax.models.hand_output import HandParameters
from poem_jax.typing import Array, Bool, Float, Num, array_namespace

MAX_ROUNDING = 1e-4
"""Metres. Results farther out than float32 rounds by this are refused."""
_MAX_DISTANCE = MAX_ROUNDING / (np.finfo(np.float32).eps / 2)


class WorkingFrame(NamedTuple):
    """A batch's cameras and known roots seen from each sample's primary camera, and the way back."""

    cams: Cameras
    """Their world is the primary camera; views that are masked or not finite are masked, and identities."""
    known_root: Float[Array, "batch 3"]
    """NaN where it is unknown."""
    complete: Bool[Array, " batch"]
    """False where image or camera of a view that `view_mask` shows is not finite."""
    R_world_from_primary: Float[Array, "batch 3 3"]
    primary_coarse_world: Float[Array, "batch 3"]
    """Centre of the primary camera, rounded to the network's type ..."""
    primary_fine_world: Float[Array, "batch 3"]
    """... and what the rounding took away."""


class Reconstruction(NamedTuple):
    """What the network found, in the primary camera's frame, metres; None = the system has no such thing."""

    keypoints_px: Float[Array, "batch view joint 2"] | None
    heat_maps: Float[Array, "batch view joint h w"] | None
    reference_joints: Float[Array, "batch joint 3"] | None
    """Triangulated key points; zero where they could not be."""
    root: Float[Array, "batch 3"] | None
    valid: Bool[Array, " batch"]
    layers: Float[Array, "batch layer query 3"]
    """Query points after every layer, in the order of the config."""
    parameters: HandParameters | None
    reference_mask: Bool[Array, "batch joint"] | None = None
    """Which key points could be triangulated."""


def enter_working_frame(
    views: Num[Array, "batch view h w 3"],
    cams: Cameras,
    root_world: Float[Array, "batch 3"] | None,
    dtype: Any,
) -> WorkingFrame:
    """Move cameras and known roots to each sample's primary camera, in float64 unless they are traced.

    Args:
        views: images; a view that holds NaN or infinity is left out, as is one whose camera does.
        cams: cameras in any world.
        root_world: known roots; NaN rows are unknown, as are all for None.
        dtype: number type in which the network computes.

    Raises:
        ValueError: the results would be rounded by more than `MAX_ROUNDING`.
    """
    finite = finite_per_view(views)
    traced = is_traced(finite, cams, root_world)
    mask = cams.view_mask if traced else np.asarray(cams.view_mask)
    K, T_cam_from_world = (
        jnp.asarray(array, dtype) if traced else np.asarray(array, np.float64) for array in cams[:2]
    )
    finite = finite & finite_per_view(K) & finite_per_view(T_cam_from_world)
    K, T_cam_from_world, shown = fill_masked_views(Cameras(K, T_cam_from_world, mask & finite))
    _, T_primary_from_world = anchor_to_primary(T_cam_from_world, shown)
    centre = invert_rigid(T_primary_from_world)[:, :3, 3]
    if not traced and dtype != np.float64:
        _check_distance(centre)
    # First to a world about the primary camera: at a kilometre a rotation that float32 rounded, and that is
    # then no exact one, would move the points.
    T_cam_from_near = _with_origin_at(T_cam_from_world, centre)
    T_cam_from_primary, T_primary_from_near = anchor_to_primary(T_cam_from_near, shown)
    T_near_from_primary = invert_rigid(T_primary_from_near)
    near_root = None if root_world is None else array_namespace(centre).asarray(root_world) - centre
    coarse = centre.astype(dtype)
    moved = Cameras(K.astype(dtype), T_cam_from_primary.astype(dtype), shown)
    return WorkingFrame(
        moved,
        _root_in_primary(near_root, T_primary_from_near).astype(dtype),
        (finite | ~mask).all(-1),
        T_near_from_primary[:, :3, :3].astype(dtype),
        coarse,
        (centre - coarse + T_near_from_primary[:, :3, 3]).astype(dtype),
    )


def leave_working_frame(
    found: Reconstruction, frame: WorkingFrame, hand: HandModel, order: QueryOrder
) -> Prediction:
    """Express what the network found in the user's world."""
    layers_world = _to_world(frame, found.layers)
    vertices_world, joints_world = split_queries(layers_world[:, -1], order)
    reference, root = found.reference_joints, found.root
    has_all_joints = reference is not None and reference.shape[1] == NUM_JOINTS
    prediction = Prediction(
        vertices_world=vertices_world,
        joints_world=joints_world,
        root_world=None if root is None else _to_world(frame, root[:, None])[:, 0],
        keypoints_px=found.keypoints_px,
        heat_maps=found.heat_maps,
        layers_world=layers_world,
        valid=found.valid & frame.complete,
        reference_joints_world=_to_world(frame, reference) if has_all_joints else None,
        reference_joints_mask=found.reference_mask if has_all_joints else None,
    )
    if found.parameters is None:
        return prediction
    # `hand_mesh` of pose, shape and translation gives the vertices in the world.
    wrist_turn = matmul(frame.R_world_from_primary, found.parameters.rotations[:, 0])
    rotations = jnp.concatenate([wrist_turn[:, None], found.parameters.rotations[:, 1:]], 1)
    resting_wrist = hand.shape(found.parameters.shape).skeleton[:, WRIST]
    return prediction._replace(
        pose=axis_angle_from_rotation(rotations),
        shape=found.parameters.shape,
        translation=joints_world[:, WRIST] - resting_wrist,
    )


def is_traced(*trees: Any) -> bool:
    """Whether any array in these pytrees is being traced by JAX."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def finite_per_view(values: Num[Array, "batch view *rest"]) -> Bool[Array, "batch view"]:
    """Whether all numbers of a view are finite."""
    if values.dtype == np.uint8:
        return np.ones(values.shape[:2], bool)
    return array_namespace(values).isfinite(values).all(tuple(range(2, values.ndim)))


def _with_origin_at(
    T_cam_from_world: Float[Array, "batch view 4 4"], centre: Float[Array, "batch 3"]
) -> Float[Array, "batch view 4 4"]:
    """Express extrinsics in worlds with their origins at `centre`; the axes stay."""
    R = T_cam_from_world[..., :3, :3]
    offset = rotate_points(R, centre[:, None, None])[..., 0, :]
    return rigid(R, T_cam_from_world[..., :3, 3] + offset)


def _root_in_primary(
    root_world: Array | None, T_primary_from_world: Float[Array, "batch 4 4"]
) -> Float[Array, "batch 3"]:
    """Move known roots; unknown ones are NaN, without letting NaN into gradients."""
    xp = array_namespace(T_primary_from_world)
    if root_world is None:
        return xp.full((len(T_primary_from_world), 3), np.nan, T_primary_from_world.dtype)
    root_world = xp.asarray(root_world, T_primary_from_world.dtype)
    known = xp.isfinite(root_world).all(-1, keepdims=True)
    root = rotate_points(T_primary_from_world[:, :3, :3], xp.where(known, root_world, 0)[:, None])[:, 0]
    return xp.where(known, root + T_primary_from_world[:, :3, 3], np.nan)


def _to_world(frame: WorkingFrame, points: Float[Array, "batch *rest 3"]) -> Float[Array, "batch *rest 3"]:
    def beside(values: Array) -> Array:
        return values.reshape(len(values), *[1] * (points.ndim - 2), 3)

    R = frame.R_world_from_primary.reshape(len(points), *[1] * (points.ndim - 3), 3, 3)
    # The small numbers first: then only the last sum rounds.
    return (rotate_points(R, points) + beside(frame.primary_fine_world)) + beside(frame.primary_coarse_world)


def _check_distance(centre: Float[Array, "batch 3"]) -> None:
    distance = np.abs(centre).max()
    if distance > _MAX_DISTANCE:
        raise ValueError(
            f"the primary camera must be within {_MAX_DISTANCE:.0f} m of the world's origin along each axis: "
            f"there float32 rounds by {1000 * MAX_ROUNDING:g} mm; got {distance:.6g} m. Subtract a point "
            "near the rig from all camera centres, and add it to the results in float64"
        )
