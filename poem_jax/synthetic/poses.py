"""A sampler of natural hand poses: families of poses within the limits of `hand/joint_limits.py`.

Angle vectors (..., 15, 3) are explained there: flexion, abduction and twist per bending joint, radians. Here
they are turned into poses of the shipped right hand: `angles_to_pose` is linear and has an exact inverse.
"""

from functools import cache

import numpy as np

from poem_jax.hand.joint_limits import ANGLE_NAMES as ANGLE_NAMES
from poem_jax.hand.joint_limits import LIMITS_DEG, NUM_BENDING_JOINTS, POSE_LIMITS, anatomical_axes
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import MANO_FINGER_NAMES
from poem_jax.synthetic.finger_collisions import posed_fingers, smallest_gap
from poem_jax.typing import Array, Float

FAMILIES = ("fist", "pinch", "counting", "flat", "grasp", "random", "point")
"""Named kinds of poses:

- fist: all long fingers curled;
- pinch: thumb tip near another tip; fingers may not overlap, so that few touch (median gap of tips 28 mm);
- counting: every long finger extended or curled by itself;
- flat: all extended;
- grasp: fingers half bent, hooked or bent at the knuckle;
- random: anything within the limits;
- point: index extended, the other long fingers curled, thumb out or opposed.
"""
FAMILY_SHARES = (0.17, 0.15, 0.17, 0.15, 0.18, 0.18, 0.0)
"""Of FAMILIES in the mixture. The benchmark draws from it, so it is frozen: "point" came later and is drawn
by name only (about 2 % of "counting" point too)."""

_LONG_FINGERS = ("index", "middle", "ring", "little")
_FINGER_STATES = {
    "extended": ((-20, 20), (0, 20), (0, 15)),
    "half": ((5, 60), (15, 70), (5, 45)),
    "curled": ((50, 85), (70, 100), (25, 65)),
    "hooked": ((-15, 25), (60, 100), (20, 65)),
    "bent": ((45, 85), (0, 30), (0, 20)),
}
_EXTENDED = list(_FINGER_STATES).index("extended")
_THUMB_STATES = {
    "out": (((-15, 8), (-8, 20), (-10, 10)), ((-10, 15), (-6, 6), (-5, 5)), ((-15, 20), (-3, 3), (-3, 3))),
    "beside": (((0, 18), (-5, 12), (-10, 10)), ((-10, 30), (-6, 6), (-5, 5)), ((-10, 30), (-3, 3), (-3, 3))),
    "opposed": (((-5, 30), (5, 30), (0, 25)), ((0, 50), (-6, 6), (-5, 5)), ((-5, 70), (-3, 3), (-3, 3))),
}
_ANY = "any"
_FAMILY_STATES = {
    "fist": (("curled",), ("out", "beside", "opposed")),
    "pinch": (("extended", "half", "curled"), ("opposed",)),
    "counting": (("extended", "curled"), ("out", "beside", "opposed")),
    "flat": (("extended",), ("out", "beside")),
    "grasp": (("half", "hooked", "bent"), ("out", "opposed")),
    "random": ((_ANY,), (_ANY,)),
    "point": (("curled",), ("out", "opposed")),
}
_CANDIDATES = 6
_ROUNDS = 12
_COLLISION_PENALTY = 1.0
_CLOSING_STEPS = (0.2, 0.12, 0.06)
_SHARED_STATE = 0.6


def sample_pose(rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 16 3"]:
    """Draw natural poses as axis-angle vectors in MANO's order; the wrist's own rotation is zero."""
    return angles_to_pose(sample_angles(rng, n))


def sample_angles(rng: np.random.Generator, n: int, family: str | None = None) -> Float[np.ndarray, "n 15 3"]:
    """Draw natural poses as anatomical angles within POSE_LIMITS.

    Poses in which fingers or palm would run into each other are drawn again (a few times; then the least
    bad of them is kept), so that about one sample in fifty still touches itself.

    Args:
        rng: source of all randomness; equal states give equal poses.
        n: number of poses.
        family: one of FAMILIES for all of them; None mixes them by FAMILY_SHARES.

    Raises:
        ValueError: `family` is none of FAMILIES.
    """
    if family is not None and family not in FAMILIES:
        raise ValueError(f"`family` must be one of {FAMILIES} or None; got {family!r}")
    shares = None if family else FAMILY_SHARES
    kinds = (
        rng.choice(len(FAMILIES), size=n, p=shares) if family is None else np.full(n, FAMILIES.index(family))
    )
    angles = np.zeros((n, NUM_BENDING_JOINTS, 3))
    best = np.full(n, -np.inf)
    pending = np.arange(n)
    for _ in range(_ROUNDS):
        if not len(pending):
            break
        drawn, score = _best_candidate(rng, kinds[pending])
        better = score > best[pending]
        angles[pending[better]], best[pending[better]] = drawn[better], score[better]
        pending = pending[best[pending] < -_COLLISION_PENALTY]
    return angles


def angles_to_pose(angles: Float[Array, "*batch 15 3"]) -> Float[Array, "*batch 16 3"]:
    """Turn anatomical angles into axis-angle vectors; row 0, the wrist, is zero."""
    bent = np.einsum("...jk,jkc->...jc", angles, joint_axes())
    return np.concatenate([np.zeros_like(bent[..., :1, :]), bent], axis=-2)


def pose_to_angles(pose: Float[Array, "*batch 16 3"]) -> Float[Array, "*batch 15 3"]:
    """Undo `angles_to_pose`; the wrist's rotation is dropped."""
    return np.einsum("...jc,jkc->...jk", pose[..., 1:, :], joint_axes())


@cache
def joint_axes() -> Float[np.ndarray, "15 3 3"]:
    """Unit axes (rows flexion, abduction, twist) of each joint of a right hand at rest, orthonormal."""
    return anatomical_axes(default_hand())


def _best_candidate(rng: np.random.Generator, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw a few poses per sample; return the best and its score (below -penalty if it touches itself)."""
    drawn = _draw(rng, np.repeat(kinds, _CANDIDATES)).reshape(-1, _CANDIDATES, NUM_BENDING_JOINTS, 3)
    pinch = kinds == FAMILIES.index("pinch")
    angles, score = _best_of(drawn, pinch)
    for spread in _CLOSING_STEPS if pinch.any() else ():
        angles[pinch], score[pinch] = _closed_further(rng, angles[pinch], spread)
    # A pinch that is as closed as it gets is as good as any other pose.
    return angles, np.where(score >= -_COLLISION_PENALTY, 0.0, score)


def _closed_further(
    rng: np.random.Generator, angles: np.ndarray, spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """Try poses around the given ones, by `spread` of each angle's range, and keep the best."""
    low, high = POSE_LIMITS[..., 0], POSE_LIMITS[..., 1]
    steps = spread * (high - low) * rng.standard_normal((len(angles), _CANDIDATES, *low.shape))
    steps[:, 0] = 0.0
    return _best_of(np.clip(angles[:, None] + steps, low, high), np.ones(len(angles), dtype=bool))


def _best_of(angles: np.ndarray, pinch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pick the best candidate (n, candidates, 15, 3) of each sample; return it and its score."""
    count = angles.shape[1]
    fingers = posed_fingers(angles_to_pose(angles.reshape(-1, NUM_BENDING_JOINTS, 3)))
    gap = smallest_gap(fingers)
    # A pinch closes: the nearer the thumb comes to another finger's tip, the better.
    thumb = MANO_FINGER_NAMES.index("thumb")
    tips = fingers[:, :, -1]
    reach = np.linalg.norm(np.delete(tips, thumb, axis=1) - tips[:, thumb : thumb + 1], axis=-1).min(axis=1)
    score = np.where(gap < 0, gap - _COLLISION_PENALTY, np.where(np.repeat(pinch, count), -reach, 0.0))
    score = score.reshape(-1, count)
    pick = score.argmax(axis=1)
    rows = np.arange(len(score))
    return angles[rows, pick], score[rows, pick]


def _draw(rng: np.random.Generator, kinds: np.ndarray) -> np.ndarray:
    """Draw every angle uniformly from the box of its finger's state; fingers often share a state."""
    boxes, choices, thumb_choices = _state_tables()
    n = len(kinds)
    own = choices[kinds[:, None], rng.integers(choices.shape[1], size=(n, len(_LONG_FINGERS)))]
    shared = (rng.random(n) < _SHARED_STATE)[:, None] & (kinds != FAMILIES.index("counting"))[:, None]
    states = np.where(shared, own[:, :1], own)
    states[kinds == FAMILIES.index("point"), _LONG_FINGERS.index("index")] = _EXTENDED
    thumbs = thumb_choices[kinds, rng.integers(thumb_choices.shape[1], size=n)]
    box = np.empty((n, 5, 3, 3, 2))
    for f, name in enumerate(MANO_FINGER_NAMES):
        box[:, f] = boxes[name][thumbs if name == "thumb" else states[:, _LONG_FINGERS.index(name)]]
    box = box.reshape(n, NUM_BENDING_JOINTS, 3, 2)
    return box[..., 0] + rng.random(box.shape[:-1]) * (box[..., 1] - box[..., 0])


@cache
def _state_tables() -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Boxes (state, 3, 3, 2) of each finger in radians, and per family the states to choose from."""
    boxes = {name: _finger_boxes(name) for name in _LONG_FINGERS}
    thumb = [np.array(box, dtype=float) for box in (*_THUMB_STATES.values(), LIMITS_DEG["thumb"])]
    boxes["thumb"] = np.deg2rad(np.stack(thumb))
    finger_names, thumb_names = [*_FINGER_STATES, _ANY], [*_THUMB_STATES, _ANY]
    chosen = [_FAMILY_STATES[family] for family in FAMILIES]
    return (
        boxes,
        np.array([_choices(states, finger_names) for states, _ in chosen]),
        np.array([_choices(states, thumb_names) for _, states in chosen]),
    )


def _finger_boxes(name: str) -> np.ndarray:
    limits = np.array(LIMITS_DEG[name], dtype=float)
    boxes = np.repeat(limits[None], len(_FINGER_STATES) + 1, axis=0)
    for k, flexions in enumerate(_FINGER_STATES.values()):
        boxes[k, :, 0] = flexions
    return np.deg2rad(boxes)


def _choices(states: tuple[str, ...], names: list[str]) -> list[int]:
    """Repeat the numbers of `states` to a common length of 6."""
    numbers = [names.index(state) for state in states]
    assert 6 % len(numbers) == 0, "a family has 1, 2, 3 or 6 states"
    return numbers * (6 // len(numbers))
