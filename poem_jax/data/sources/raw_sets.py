"""What all readers of raw data sets ask of a folder: that it is there, that it is whole, where to get it."""

import hashlib
import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from poem_jax.data.frames import CorruptSampleError, EncodedImage
from poem_jax.hand.topology import SKELETON_FROM_OPENPOSE
from poem_jax.typing import Array, Float

MAX_IMAGE_BYTES = 2**26
"""64 MiB; the images of the public sets have up to 8."""
_SHARE_OF_WHOLE = 0.5
"""With fewer frames than this share of the whole, a copy is a part of the set: its count tells nothing."""

_log = logging.getLogger(__name__)


def find_folder(root: str | Path, names: Sequence[str], marker: str, *, advice: str) -> Path:
    """Return the folder that holds `marker`: `root` itself, or one of `names` within it.

    Args:
        root: What the user gives.
        names: How the data set's own folder is called.
        marker: A file or folder that stands in it.
        advice: Where to get the data set, for the message.

    Raises:
        FileNotFoundError: Neither holds it.
    """
    root = Path(root)
    for folder in (root, *(root / name for name in names)):
        if (folder / marker).exists():
            return folder
    state = f"{root} holds neither" if root.is_dir() else f"{root} is no folder; expected one that holds"
    raise FileNotFoundError(f"{state} {marker} nor {' nor '.join(f'{n}/{marker}' for n in names)}. {advice}")


def need_file(path: Path, what: str, *, advice: str) -> Path:
    """Return the path of a file without which the set cannot be opened.

    Raises:
        FileNotFoundError: It is missing; says what it is and where to get it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{what} is missing: expected {path}. {advice}")
    return path


def check_choice(
    name: str, value: str, choices: Iterable[str], *, why: Mapping[str, str] | None = None
) -> None:
    """Insist that an option has one of its values.

    Raises:
        ValueError: It has not; `why` gives reasons for values that one could expect.
    """
    choices = tuple(choices)
    if value not in choices:
        reason = f": {why[value]}" if why and value in why else ""
        raise ValueError(f"`{name}` must be one of {', '.join(choices)}; got {value!r}{reason}")


def numbers(value: object, shape: tuple[int, ...], where: str) -> Float[Array, "..."]:
    """Return what a calibration file says as an array.

    Args:
        value: Lists of numbers, or whatever stands in their place.
        shape: That it must have, but for axes of length one.
        where: File and field, for the message.

    Raises:
        ValueError: It is no such array, or not finite.
    """
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} must be numbers of shape {shape}; {error}") from error
    if [n for n in array.shape if n != 1] != [n for n in shape if n != 1]:
        raise ValueError(f"{where} must have shape {shape}; got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{where} must be finite; it is not")
    return array.reshape(shape)


def check_count(
    name: str, found: int, expected: int | None, *, strict: bool, counted_by: str = "the paper counts"
) -> None:
    """Compare the number of frames with that of a whole set; parts of one (less than half) are let pass.

    Args:
        name: Of the source.
        found: Frames in it.
        expected: Frames in the whole set; None = not known.
        strict: Raise instead of a warning, and whatever the number.
        counted_by: Who counted those that are expected, and a verb, for the message.

    Raises:
        ValueError: `strict`, and the counts differ.
    """
    if expected is None or found == expected or (not strict and found < _SHARE_OF_WHOLE * expected):
        return
    message = (
        f"{name} has {found} frames, and {counted_by} {expected}: files may be missing, or the set is of "
        "another release"
    )
    if strict:
        raise ValueError(message)
    _log.warning("%s", message)


def check_mesh(
    mesh_joints: Float[Array, "view 21 3"],
    joints: Float[Array, "view 21 3"],
    path: Path,
    key: str,
    *,
    max_apart_m: float = 0.02,
) -> None:
    """Insist that the skeleton of a mesh is that of the labels; finger tips, which sets define otherwise, may
    differ.

    Args:
        mesh_joints: Of MANO, metres.
        joints: As labelled, in the same frame.
        path: File of the labels, for the message.
        key: Of the sample, for the message.
        max_apart_m: Bound on the distance of a joint from its label; sets whose joints were not made by MANO
            need more.

    Raises:
        CorruptSampleError: They are further apart: labels that are wrong, or another MANO file or convention
            than those of the set.
    """
    skeleton = list(SKELETON_FROM_OPENPOSE)
    apart = np.linalg.norm(mesh_joints[:, skeleton] - joints[:, skeleton], axis=-1).max()
    # Written so that NaN fails too.
    if not apart <= max_apart_m:
        raise CorruptSampleError(
            path,
            key,
            f"MANO's joints lie up to {apart:.3g} m from the labelled ones; expected at most {max_apart_m}. "
            "If all samples fail, the MANO file is not the one that the set was labelled with",
        )


def read_image(path: Path, key: str) -> EncodedImage:
    """Return an image file as it lies there.

    Raises:
        CorruptSampleError: It is missing, empty or absurdly large.
    """
    try:
        size = path.stat().st_size
        if not 0 < size <= MAX_IMAGE_BYTES:
            raise CorruptSampleError(
                path, key, f"an image must have 1 to {MAX_IMAGE_BYTES} bytes; got {size}"
            )
        return EncodedImage(path.read_bytes(), str(path))
    except OSError as error:
        raise CorruptSampleError(path, key, f"the image cannot be read: {error.strerror}") from error


def identify(path: Path) -> str:
    """Return what identifies the content of a list file: its size and its SHA-256."""
    with path.open("rb") as stream:
        return f"{path.stat().st_size} bytes, sha256 {hashlib.file_digest(stream, 'sha256').hexdigest()}"


def identify_list(keys: Iterable[str]) -> str:
    """Return what identifies a list of samples: their number and the SHA-256 of their keys."""
    digest, count = hashlib.sha256(), 0
    for key in keys:
        digest.update(key.encode() + b"\n")
        count += 1
    return f"{count} samples, sha256 {digest.hexdigest()}"
