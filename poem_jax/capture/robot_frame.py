"""The frame in which programs that steer robot hands expect a human hand's joints.

x out of the palm, z from the wrist to the middle knuckle, y completes them: towards the thumb's side on a
right hand, away from it on a left one. The origin is the wrist. So do dex-retargeting's examples feed it, and
so stand Allegro hands.
"""

import numpy as np

from poem_jax.geometry.transforms import unit_vectors
from poem_jax.hand.topology import INDEX_KNUCKLE, LITTLE_KNUCKLE, ROOT_JOINT, WRIST
from poem_jax.typing import Array, Float


def joints_in_palm_frame(
    joints_world: Float[Array, "*batch 21 3"], *, side: str
) -> Float[np.ndarray, "*batch 21 3"]:
    """Return joints (OpenPose order, metres) about the wrist, in axes that the palm carries.

    Args:
        joints_world: In any world.
        side: "right" or "left".

    Raises: ValueError: another side.
    """
    if side not in ("right", "left"):
        raise ValueError(f'`side` must be "right" or "left"; got {side!r}')
    joints = np.asarray(joints_world, np.float64)
    joints = joints - joints[..., WRIST : WRIST + 1, :]
    z = unit_vectors(joints[..., ROOT_JOINT, :])
    across = np.cross(joints[..., LITTLE_KNUCKLE, :], joints[..., INDEX_KNUCKLE, :])
    out_of_palm = -across if side == "right" else across
    x = unit_vectors(out_of_palm - (out_of_palm * z).sum(-1, keepdims=True) * z)
    R_palm_from_world = np.stack([x, np.cross(z, x), z], axis=-2)
    return np.einsum("...ij,...kj->...ki", R_palm_from_world, joints)
