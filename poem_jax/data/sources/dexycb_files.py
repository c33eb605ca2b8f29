"""DexYCB's lists and calibration files; see `dexycb.py`."""

import logging
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.data.sources.annotation_cache import cache_path
from poem_jax.data.sources.label_npz import read_label_arrays
from poem_jax.data.sources.raw_sets import need_file
from poem_jax.geometry.transforms import rigid
from poem_jax.io.atomic import whole_file
from poem_jax.io.npz_file import read_npz
from poem_jax.io.yaml_file import read_yaml
from poem_jax.typing import Array, Bool, Float

ADVICE = "Get DexYCB from dex-ycb.github.io (CC BY-NC 4.0) and unpack all its archives into one folder"
SERIALS = (
    "836212060125",
    "839512060362",
    "840412060917",
    "841412060263",
    "932122060857",
    "932122060861",
    "932122061900",
    "932122062010",
)
WIDTH, HEIGHT = 640, 480
LABEL_SHAPES = {"joint_3d": (1, 21, 3), "joint_2d": (1, 21, 2), "pose_m": (1, 51)}
NUM_SUBJECTS, SEQUENCES_PER_SUBJECT = 10, 100
_SUBJECT = re.compile(r"\d{8}-.+")
_NUMBERED = re.compile(r"\d{8}-subject-(\d\d)")
_MAX_FRAMES = 100_000

_log = logging.getLogger(__name__)


class Sequence(NamedTuple):
    """What `meta.yml` says of a sequence."""

    name: str
    """`<subject>/<date_time>`."""
    num_frames: int
    side: str
    extrinsics: str
    betas: Float[Array, "10"]


def is_in_split(setup: str, split: str, subject: int, sequence: int) -> bool:
    """Tell whether a sequence, by its place among its subject's 100, belongs to a split (dex-ycb-toolkit)."""
    held_out = sequence % 5 == 4
    if setup == "s0":
        return held_out == (split != "train") and (split == "train" or (subject < 2) == (split == "val"))
    if setup == "s1":
        return {6: "val", 7: "test", 8: "test"}.get(subject, "train") == split
    return {3: "val", 19: "val", 7: "test", 11: "test", 15: "test"}.get(sequence // 5, "train") == split


def read_sequences(root: Path, setup: str, split: str, *, strict: bool = False) -> list[Sequence]:
    """Return the sequences of a split, in order of subject and time.

    Args:
        root: The set's folder.
        setup: Of the splits.
        split: Of the setup.
        strict: Insist on 100 sequences of each subject; else a warning is logged.

    Raises:
        FileNotFoundError: There is none, or a calibration that one names is missing.
        ValueError: A damaged `meta.yml` or `mano.yml`; `strict`, and a subject has another number of
            sequences.
    """
    folders = sorted(f for f in root.iterdir() if f.is_dir() and _SUBJECT.fullmatch(f.name))
    sequences, without_meta = [], []
    for place, folder in enumerate(folders):
        subject = _subject_number(folder.name, place, len(folders), root)
        names = sorted(f.name for f in folder.iterdir() if f.is_dir())
        if len(names) != SEQUENCES_PER_SUBJECT:
            message = (
                f"{folder} has {len(names)} sequences of {SEQUENCES_PER_SUBJECT}: splits go by a sequence's "
                "place, so this split is another"
            )
            if strict:
                raise ValueError(f"{message}. {ADVICE}")
            _log.warning("%s", message)
        for number, name in enumerate(names):
            if not is_in_split(setup, split, subject, number):
                continue
            if (folder / name / "meta.yml").is_file():
                sequences.append(_read_meta(root, f"{folder.name}/{name}"))
            else:
                without_meta.append(f"{folder.name}/{name}")
    if without_meta:
        _log.warning(
            "%s: %d sequences without meta.yml are left out, the first is %s",
            *(root, len(without_meta), without_meta[0]),
        )
    if not sequences:
        raise FileNotFoundError(
            f"{root} has no sequence of {setup} {split}: expected folders <date>-subject-01 to -10, each "
            f"with {SEQUENCES_PER_SUBJECT} sequences that have a meta.yml; got {len(folders)} subjects. "
            f"{ADVICE}"
        )
    return sequences


def _subject_number(name: str, place: int, count: int, root: Path) -> int:
    if match := _NUMBERED.fullmatch(name):
        return int(match[1]) - 1
    if count != NUM_SUBJECTS:
        raise FileNotFoundError(
            f"{root} has {count} subjects, and {name} does not tell its number, on which splits depend: "
            f"expected all {NUM_SUBJECTS}. {ADVICE}"
        )
    return place


def _read_meta(root: Path, name: str) -> Sequence:
    path = root / name / "meta.yml"
    meta = _mapping(read_yaml(path), path)
    try:
        num_frames, side = int(meta["num_frames"]), str(meta["mano_sides"][0])
        extrinsics, mano = _id(meta["extrinsics"]), _id(meta["mano_calib"][0])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(
            f"{path} must have num_frames, mano_sides, mano_calib and extrinsics; "
            f"{type(error).__name__}: {error}"
        ) from error
    if not 0 <= num_frames <= _MAX_FRAMES or side not in ("right", "left"):
        raise ValueError(f"{path}: expected a number of frames and a side; got {num_frames} and {side!r}")
    return Sequence(name, num_frames, side, extrinsics, _read_betas(root, mano))


def _id(value: Any) -> str:
    """Return part of a file's name; YAML takes some ids for whole numbers."""
    text = str(value)
    if not re.fullmatch(r"[\w.-]+", text) or ".." in text:
        raise ValueError(f"{text[:60]!r} is no name of a calibration")
    return text


def _read_betas(root: Path, mano: str) -> Float[Array, "10"]:
    path = need_file(
        root / "calibration" / f"mano_{mano}" / "mano.yml", "a hand's calibration", advice=ADVICE
    )
    return _numbers(_mapping(read_yaml(path), path).get("betas"), 10, path, "betas").astype(np.float32)


def read_extrinsics(root: Path, name: str) -> Float[Array, "camera 4 4"]:
    """Return `T_master_from_cam` of all cameras, metres, in the order of `SERIALS`."""
    path = need_file(
        root / "calibration" / f"extrinsics_{name}" / "extrinsics.yml", "a calibration", advice=ADVICE
    )
    stored = _mapping(_mapping(read_yaml(path), path).get("extrinsics"), path)
    rows = [_numbers(stored.get(serial), 12, path, serial).reshape(3, 4) for serial in SERIALS]
    stacked = np.stack(rows)
    return rigid(stacked[..., :3], stacked[..., 3])


def read_intrinsics(root: Path) -> Float[Array, "camera 3 3"]:
    """Return K of the colour cameras as stored: pixel (0, 0) is a pixel's centre."""
    matrices = []
    for serial in SERIALS:
        path = root / "calibration" / "intrinsics" / f"{serial}_{WIDTH}x{HEIGHT}.yml"
        need_file(path, "the intrinsics of a camera", advice=ADVICE)
        colour = _mapping(_mapping(read_yaml(path), path).get("color"), path)
        fx, fy, cx, cy = _numbers([colour.get(n) for n in ("fx", "fy", "ppx", "ppy")], 4, path, "color")
        matrices.append([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return np.array(matrices)


def views_with_hand(root: Path, sequence: Sequence) -> Bool[Array, "camera frame"]:
    """Tell in which images of a sequence the hand is labelled (no `joint_2d` is -1).

    Labels that are missing or damaged count as present: the frame is then named when it is read. What is
    found is kept in the user's cache, unless a label was such a one: it may be there the next time.
    """
    folder = root / sequence.name
    times = [(folder / s).stat().st_mtime_ns if (folder / s).is_dir() else 0 for s in SERIALS]
    identity = (str(root.resolve()), sequence.name, sequence.num_frames, times)
    cached = cache_path("dexycb", sequence.name.replace("/", "-"), *identity, suffix=".npz")
    if cached.is_file():
        return read_npz(cached, required=["shown"])["shown"]
    _log.info("reading the key points of %s once", folder)
    shown = np.ones((len(SERIALS), sequence.num_frames), bool)
    unread = 0
    for camera, serial in enumerate(SERIALS):
        for frame in range(sequence.num_frames):
            is_shown = _shows_hand(folder / serial / f"labels_{frame:06d}.npz")
            shown[camera, frame] = is_shown is not False
            unread += is_shown is None
    if unread:
        _log.warning("%s: %d labels cannot be read; the list of its views is not kept", folder, unread)
        return shown
    with whole_file(cached) as temporary:
        np.savez(temporary, shown=shown)
    return shown


def _shows_hand(path: Path) -> bool | None:
    """Tell whether a label has the hand's key points; None where it cannot be read."""
    try:
        joint_2d = read_label_arrays(path, {"joint_2d": LABEL_SHAPES["joint_2d"]})["joint_2d"]
    except ValueError:
        return None
    return not (joint_2d == -1).any()


def _mapping(value: Any, path: Path) -> dict:
    if not isinstance(value, dict):
        raise ValueError(f"{path} must hold a map of names and values there; got a {type(value).__name__}")
    return value


def _numbers(value: Any, count: int, path: Path, name: str) -> Float[Array, " count"]:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: `{name}` must be {count} numbers; {error}") from error
    if array.shape != (count,) or not np.isfinite(array).all():
        raise ValueError(f"{path}: `{name}` must be {count} finite numbers; got shape {array.shape}")
    return array
