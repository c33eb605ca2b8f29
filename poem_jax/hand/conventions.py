"""The same hand pose in other conventions: MANO's principal components, and SMPL-X's hands.

Here a pose is 16 axis-angle vectors of the hand's own side, zero = flat hand. MANO's file writes the 45
numbers of the fingers as mean + coefficients @ components (Romero et al. 2017, section 5). SMPL-X stores
finger rotations relative to that mean and gives the left hand as the mirror image of the right one: its mean
is the right one's with y and z negated, and no separate left file is needed.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.hand.model import mirror_pose
from poem_jax.hand.topology import NUM_SKELETON_JOINTS
from poem_jax.typing import Array, Float, array_namespace

_FINGERS = NUM_SKELETON_JOINTS - 1
FINGER_NUMBERS = 3 * _FINGERS


class PoseComponents(NamedTuple):
    """Principal components of finger poses, of one side."""

    mean: Float[Array, "45"]
    """Axis-angle of joints 1..15, radians."""
    components: Float[Array, "component 45"]
    """Directions, the most important first; MANO's are orthonormal."""

    def coefficients(self, pose: Float[Array, "*batch 16 3"], count: int) -> Float[Array, "*batch count"]:
        """Return the first `count` coefficients of a pose's fingers, least squares.

        Raises: ValueError: there are not so many components.
        """
        xp = array_namespace(pose)
        if not 0 < count <= len(self.components):
            raise ValueError(f"`count` must be from 1 to {len(self.components)}; got {count}")
        fingers = pose[..., 1:, :].reshape(*pose.shape[:-2], FINGER_NUMBERS)
        inverse = np.linalg.pinv(np.asarray(self.components[:count], np.float64))
        return xp.matmul(fingers - self.mean, inverse.astype(pose.dtype))

    def pose(
        self, wrist: Float[Array, "*batch 3"], coefficients: Float[Array, "*batch count"]
    ) -> Float[Array, "*batch 16 3"]:
        """Return the pose of a wrist rotation (axis-angle) and as many coefficients as are given."""
        xp = array_namespace(wrist, coefficients)
        fingers = self.mean + xp.matmul(coefficients, self.components[: coefficients.shape[-1]])
        return xp.concatenate([wrist[..., None, :], fingers.reshape(*wrist.shape[:-1], _FINGERS, 3)], axis=-2)


class SmplxHand(NamedTuple):
    """One hand as `smplx.MANO(flat_hand_mean=False)` and SMPL-X's hands take it."""

    global_orient: Float[Array, "*batch 3"]
    """The wrist's rotation."""
    hand_pose: Float[Array, "*batch 45"]
    """Fingers, less the mean pose."""


def to_smplx(pose: Float[Array, "*batch 16 3"], right_mean: Float[Array, "45"], *, side: str) -> SmplxHand:
    """Return a pose of the given side relative to the mean pose.

    Args:
        pose: axis-angle, MANO order, zero = flat hand, of a hand of `side`.
        right_mean: MANO's `hands_mean` of the right hand (`load_pose_components(path).mean`).
        side: "right" or "left". Shape and translation are the same in both conventions.

    Raises: ValueError: another side.
    """
    fingers = pose[..., 1:, :].reshape(*pose.shape[:-2], FINGER_NUMBERS)
    return SmplxHand(pose[..., 0, :], fingers - _mean_of(side, right_mean))


def from_smplx(hand: SmplxHand, right_mean: Float[Array, "45"], *, side: str) -> Float[Array, "*batch 16 3"]:
    """Invert `to_smplx`; arguments and errors as there."""
    xp = array_namespace(*hand)
    fingers = hand.hand_pose + _mean_of(side, right_mean)
    fingers = fingers.reshape(*hand.hand_pose.shape[:-1], _FINGERS, 3)
    return xp.concatenate([hand.global_orient[..., None, :], fingers], axis=-2)


def _mean_of(side: str, right_mean: Float[Array, "45"]) -> Float[Array, "45"]:
    if side not in ("right", "left"):
        raise ValueError(f'`side` must be "right" or "left"; got {side!r}')
    return right_mean if side == "right" else mirror_pose(right_mean.reshape(_FINGERS, 3)).reshape(-1)
