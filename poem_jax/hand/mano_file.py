"""Open the user's MANO files: `MANO_RIGHT.pkl`, `MANO_LEFT.pkl`, or an `.npz` with MANO's field names.

The pickles were written by Python 2 and hold chumpy variables and a scipy sparse matrix. Neither library is
needed, nor is the pickle trusted: `io/safe_pickle.py` keeps their state in inert stand-ins, and the arrays
are taken out here. MANO's mean pose is not used in the hand: as in the released models, zero pose means the
flat hand; `load_pose_components` reads it for conversions.

The `MANO_LEFT.pkl` that was published has a known fault: the x components of its `shapedirs` were not
mirrored with the hand, so that shape coefficients which should lengthen the fingers shorten them. It is
recognised by the shape directions themselves and mended, with a warning.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.hand.conventions import FINGER_NUMBERS, PoseComponents
from poem_jax.hand.mano_pickle import as_array
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import (
    MANO_PARENTS,
    NUM_FACES,
    NUM_POSE_FEATURES,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    NUM_VERTICES,
)
from poem_jax.io.npz_file import read_npz
from poem_jax.io.safe_pickle import StandIn, load_arrays_pickle
from poem_jax.io.sparse_matrices import is_sparse_matrix

_SHAPES = {
    "v_template": (NUM_VERTICES, 3),
    "shapedirs": (NUM_VERTICES, 3, NUM_SHAPES),
    "posedirs": (NUM_VERTICES, 3, NUM_POSE_FEATURES),
    "J_regressor": (NUM_SKELETON_JOINTS, NUM_VERTICES),
    "weights": (NUM_VERTICES, NUM_SKELETON_JOINTS),
    "f": (NUM_FACES, 3),
}
_COMPONENT_SHAPES = {
    "hands_mean": (FINGER_NUMBERS,),
    "hands_components": (FINGER_NUMBERS, FINGER_NUMBERS),
}
_KNUCKLES = (1, 4, 7, 10)
"""First joints of index, middle, little and ring finger in MANO's order."""
_THUMB = 4
"""The last of MANO's fingers."""
_SUM_TOLERANCE = 1e-3
_EXTENT_M = (0.05, 1.0)
"""Of any hand in metres."""
_MIN_STEP = 1e-4
"""Of shape and pose directions, as a share of the hand's extent; ours reach 0.05."""
_MAX_BONE = 0.35
"""A finger's longest bone as a share of the hand's extent; our own hand has 0.24."""
_CLEAR_AGREEMENT = 0.3
"""Beyond this, `_agreement_of_length_and_width` tells: +0.80 for our own hand, -0.80 with the fault, and
0 +- 0.3 for shape directions of random numbers."""

_log = logging.getLogger(__name__)


def load(path: str | Path, side: str | None = None) -> HandModel:
    """Read a hand in MANO's schema from `.pkl` or `.npz`, as float32 NumPy arrays.

    Args:
        path: the file; neither chumpy nor scipy is needed, and nothing in the file is run.
        side: "right" or "left"; None takes it from the file's name or, where that says neither or both, from
            the hand: in MANO's frame the fingers of a right hand point along -x.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another kind of file, a damaged or hostile one, a missing field, a wrong shape or value.
    """
    if side not in (None, "right", "left"):
        raise ValueError(f'`side` must be "right", "left" or None; got {side!r}')
    return _hand_model(_read(Path(path)), str(path), side)


def load_pose_components(path: str | Path) -> PoseComponents:
    """Read the mean pose and the principal components of a hand in MANO's schema.

    Raises:
        FileNotFoundError, ValueError: as `load`, or the file lacks `hands_mean` or `hands_components`.
    """
    fields = _read(Path(path))
    missing = [name for name in _COMPONENT_SHAPES if name not in fields]
    if missing:
        raise ValueError(f"{path} must have {', '.join(_COMPONENT_SHAPES)}; missing: {', '.join(missing)}")
    return PoseComponents(*(_checked(name, fields[name], str(path)) for name in _COMPONENT_SHAPES))


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(
            f"no hand model at {path}; give MANO_RIGHT.pkl or MANO_LEFT.pkl (from mano.is.tue.mpg.de), "
            "or an .npz with MANO's field names"
        )
    if path.suffix == ".npz":
        return read_npz(path)
    if path.suffix == ".pkl":
        return _read_pickle(path)
    raise ValueError(f"{path} must end in .pkl or .npz; got {path.suffix or 'no suffix'!r}")


def _read_pickle(path: Path) -> dict[str, Any]:
    fields = load_arrays_pickle(path, stand_ins=_holds_arrays)
    if not isinstance(fields, Mapping):
        raise ValueError(f"{path} must hold a dictionary of MANO's fields; got a {type(fields).__name__}")
    return {key.decode("latin1") if isinstance(key, bytes) else str(key): fields[key] for key in fields}


def _holds_arrays(module: str, name: str) -> bool:
    """Classes of the genuine files that are replaced by stand-ins."""
    package = module.partition(".")[0]
    return (package == "chumpy" and name[:1].isupper()) or is_sparse_matrix(module, name)


def _hand_model(fields: Mapping[str, Any], source: str, side: str | None) -> HandModel:
    missing = [name for name in _SHAPES if name not in fields]
    if missing:
        raise ValueError(
            f"{source} must have the fields {', '.join(_SHAPES)}; missing: {', '.join(missing)}; "
            f"got: {', '.join(sorted(fields)) or 'none'}. Is it a MANO hand (not SMPL, not a pose file)?"
        )
    arrays = {name: _checked(name, fields[name], source) for name in _SHAPES}
    _check_values(arrays, fields.get("kintree_table"), source)
    left = (side or _side(arrays, source)) == "left"
    return HandModel(
        v_template=arrays["v_template"],
        shapedirs=_mirrored_with_hand(arrays, source) if left else arrays["shapedirs"],
        posedirs=arrays["posedirs"],
        J_regressor=arrays["J_regressor"],
        weights=arrays["weights"],
        faces=arrays["f"],
        is_left=np.array(left),
    )


def _side(arrays: Mapping[str, np.ndarray], source: str) -> str:
    """Tell the side by the file's name; where that does not, by the direction of the fingers."""
    skeleton = arrays["J_regressor"] @ arrays["v_template"]
    fingers = skeleton[list(_KNUCKLES)].mean(axis=0) - skeleton[0]
    shown = "right" if fingers[0] < 0 else "left"
    named = [side for side in ("left", "right") if side in Path(source).name.lower()]
    if named and shown not in named:
        _log.warning(
            "%s is read as a %s hand after its name, but its fingers point along %sx as a %s hand's; "
            "if that is wrong, rename the file",
            *(source, named[0], "-+"[shown == "left"], shown),
        )
    return named[0] if len(named) == 1 else shown


def _mirrored_with_hand(arrays: Mapping[str, np.ndarray], source: str) -> np.ndarray:
    """Return the shape directions of a left hand, x turned round where it was not mirrored with the hand."""
    shapedirs = arrays["shapedirs"]
    agreement = _agreement_of_length_and_width(arrays["v_template"], shapedirs)
    if agreement < -_CLEAR_AGREEMENT:
        _log.warning(
            "the x components of `shapedirs` in %s are not mirrored with the hand, a known fault of the "
            "published MANO_LEFT.pkl: they are turned round; shape coefficients that were found with the "
            "faulty file belong to other hands here",
            source,
        )
        return shapedirs * np.array([-1, 1, 1], np.float32)[:, None]
    if agreement < _CLEAR_AGREEMENT:
        _log.warning(
            "the x components of `shapedirs` in %s stay as they are: whether they are mirrored with the "
            "hand, unlike those of the published MANO_LEFT.pkl, cannot be told",
            source,
        )
    return shapedirs


def _agreement_of_length_and_width(v_template: np.ndarray, shapedirs: np.ndarray) -> float:
    """Return how far the hand grows along x (fingers) where it grows along z (palm), from -1 to 1.

    Sizes of hands vary more than their proportions, so of the shape directions, scaled by how much they vary
    among people, length and width mostly grow together. Growth is the slope of displacement over position;
    the result is the correlation (about zero) of the two slopes over the ten directions.
    """
    place = (v_template - v_template.mean(axis=0)).astype(np.float64)
    # Not divided by the spread of the places, which the correlation does not know either.
    length, _, width = np.einsum("vc,vck->ck", place, shapedirs)
    size = np.linalg.norm(length) * np.linalg.norm(width)
    return float(length @ width / size) if size > 0 else 0.0


def _checked(name: str, value: Any, source: str) -> np.ndarray:
    """Return one field as a finite array of its type and shape."""
    array = _array(name, value, source)
    expected = {**_SHAPES, **_COMPONENT_SHAPES}[name]
    if array is None or array.dtype.kind not in "fiu":
        raise ValueError(f"`{name}` in {source} must be an array of numbers {expected}; got {_kind(value)}")
    if array.shape != expected:
        raise ValueError(f"`{name}` in {source} must have shape {expected}; got {array.shape}")
    if name == "f":
        _check_faces(array, source)
        return np.ascontiguousarray(array, dtype=np.int32)
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=np.float32)
    if not np.isfinite(array).all():
        raise ValueError(
            f"`{name}` in {source} must be finite; got NaN, infinity or numbers as large. "
            "Is the file damaged?"
        )
    return array


def _array(name: str, value: Any, source: str) -> np.ndarray | None:
    try:
        return as_array(value)
    except ValueError as error:
        raise ValueError(f"`{name}` in {source} is damaged: {error}") from error


def _check_faces(faces: np.ndarray, source: str) -> None:
    # Written so that NaN fails too.
    if not (faces.min() >= 0 and faces.max() < NUM_VERTICES and (faces == faces.round()).all()):
        raise ValueError(
            f"`f` in {source} must hold vertex numbers 0..{NUM_VERTICES - 1}; "
            f"got {faces.min()}..{faces.max()}"
        )
    a, b, c = faces.T
    if (flat := (a == b) | (b == c) | (c == a)).any():
        raise ValueError(
            f"`f` in {source} must hold three vertices a face; {flat.sum()} faces name one twice, the first "
            f"is {faces[flat.argmax()].astype(int).tolist()}"
        )


def _kind(value: Any) -> str:
    if isinstance(value, StandIn):
        return f"a {value.module}.{value.name} whose values were not found"
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of dtype {value.dtype}"
    return f"a {type(value).__name__}"


def _check_values(arrays: Mapping[str, np.ndarray], tree: Any, source: str) -> None:
    extent = np.ptp(arrays["v_template"].astype(float), axis=0).max()
    if not _EXTENT_M[0] <= extent <= _EXTENT_M[1]:
        raise ValueError(
            f"`v_template` in {source} must be in metres; got a hand {extent:.3g} long. "
            "Divide millimetres by 1000, centimetres by 100."
        )
    for name in ("J_regressor", "weights"):
        sums = arrays[name].astype(float).sum(axis=1)
        if np.abs(sums - 1).max() > _SUM_TOLERANCE:
            raise ValueError(
                f"rows of `{name}` in {source} must sum to 1; "
                f"got sums from {sums.min():.4g} to {sums.max():.4g}"
            )
    for name in ("shapedirs", "posedirs"):
        # Moved by more than a hand's length by one coefficient, or by one entry of R - 1; or by nothing that
        # could be seen, unless there is none at all.
        step = np.linalg.norm(arrays[name].astype(float), axis=1).max()
        if step > extent or 0 < step < _MIN_STEP * extent:
            raise ValueError(
                f"`{name}` in {source} must be in metres; got steps of up to {step:.3g} for a hand "
                f"{extent:.3g} long. Is it in another unit than `v_template`?"
            )
    _check_tree(tree, source)
    _check_joints(arrays, extent, source)


def _check_joints(arrays: Mapping[str, np.ndarray], extent_m: float, source: str) -> None:
    """The joints must come in MANO's order, in `J_regressor` and in `weights` alike."""
    v_template, weights = (arrays[name].astype(float) for name in ("v_template", "weights"))
    joints = arrays["J_regressor"].astype(float) @ v_template
    if (got := _another_order(joints, extent_m)) is not None:
        raise ValueError(
            f"`J_regressor` in {source} must give the joints in MANO's order (wrist; index, middle, little, "
            f"ring finger, thumb, each from its base); got {got}"
        )
    moves = weights.sum(0)
    if (moves <= 0).any():
        raise ValueError(
            f"`weights` in {source} must move vertices with each joint; none follows joint "
            f"{(moves <= 0).argmax()}"
        )
    # What joints move lies about them in the order in which they lie, whatever the hand's size and turn.
    moved = weights.T @ v_template / moves[:, None]
    alike = np.einsum("abx,abx->ab", *(points[1:, None] - points[1:] for points in (joints, moved)))
    if (alike + np.eye(len(alike)) <= 0).any():
        first, second = 1 + np.argwhere(alike + np.eye(len(alike)) <= 0)[0]
        raise ValueError(
            f"the columns of `weights` in {source} must come in the order of the rows of `J_regressor`; got "
            f"weights of joints {first} and {second} that lie the other way round"
        )


def _another_order(joints: np.ndarray, extent_m: float) -> str | None:
    """Say what shows that the joints (16, 3) of a resting hand are in another order; None = nothing does."""
    child = np.array([joint for joint, parent in enumerate(MANO_PARENTS) if parent > 0])
    bones = np.linalg.norm(joints[child] - joints[np.array(MANO_PARENTS)[child]], axis=1) / extent_m
    if bones.max() > _MAX_BONE:
        joint = child[bones.argmax()]
        return f"{bones.max():.0%} of the hand's length from joint {joint} to the one before it in its finger"
    from_wrist = np.linalg.norm(joints[1:] - joints[0], axis=1).reshape(-1, 3)
    if (np.diff(from_wrist, axis=1) <= 0).any():
        return "a joint of a finger nearer to the wrist than the one before it"
    if from_wrist[:, 0].argmin() != _THUMB:
        return "a knuckle nearer to the wrist than the base of the thumb"
    index, middle, little, ring = joints[list(_KNUCKLES)]
    across = np.array([index, middle, ring, little]) @ (little - index)
    thumb = joints[1 + 3 * _THUMB]
    if (np.diff(across) <= 0).any() or np.linalg.norm(thumb - index) >= np.linalg.norm(thumb - little):
        return "knuckles in another order across the palm"
    return None


def _check_tree(tree: Any, source: str) -> None:
    """The joints must hang together as MANO's; the root's parent is written as -1 or as its unsigned wrap."""
    if tree is None:
        return
    table = _array("kintree_table", tree, source)
    expected = list(MANO_PARENTS[1:])
    readable = table is not None and table.shape == (2, NUM_SKELETON_JOINTS) and table.dtype.kind in "fiu"
    got = table[0, 1:].tolist() if readable else _kind(tree)  # type: ignore[index]
    if got != expected:
        raise ValueError(f"`kintree_table` in {source} must have MANO's parents {expected}; got {got}")
