"""What a path is: released tars, the folder of a raw data set, or a capture; by what lies in it.

The folders are those of the data sets as they are unpacked; the readers accept the same ones.
"""

import enum
from collections.abc import Callable, Mapping
from pathlib import Path

from poem_jax.data.capture_folder import RIG_FILES, find_rig_file
from poem_jax.data.capture_labels import LABEL_FILES
from poem_jax.data.shards import is_hidden
from poem_jax.mixture.config import (
    ArcticSource,
    CapturesSource,
    DexYCBSource,
    FramesSource,
    FreiHANDSource,
    HO3DSource,
    InterHandSource,
    OakInkSource,
    ReleasedTarsSource,
)


class Kind(enum.StrEnum):
    """Kinds of sources, as `--kind` names them."""

    TARS = "tars"
    CAPTURE = "capture"
    DEXYCB = "dexycb"
    HO3D_V2 = "ho3d-v2"
    HO3D_V3 = "ho3d-v3"
    OAKINK = "oakink"
    ARCTIC = "arctic"
    INTERHAND = "interhand"
    FREIHAND = "freihand"


NEED_MANO = frozenset({Kind.DEXYCB, Kind.HO3D_V2, Kind.HO3D_V3, Kind.ARCTIC, Kind.INTERHAND})
"""Raw sets that store MANO's parameters and no vertices."""
_NAMES = {
    Kind.DEXYCB: ("DexYCB", "dex-ycb", "dexycb"),
    Kind.HO3D_V2: ("HO3D_v2", "ho3d_v2"),
    Kind.HO3D_V3: ("HO3D_v3", "ho3d_v3"),
    Kind.OAKINK: ("OakInk", "oakink"),
    Kind.ARCTIC: ("arctic_data", "arctic", "Arctic"),
    Kind.INTERHAND: ("InterHand2.6M", "InterHand", "interhand"),
    Kind.FREIHAND: ("FreiHAND_v2", "FreiHAND_pub_v2", "FreiHAND", "freihand"),
}
"""How the sets' own folders are called."""


def recognise(path: str | Path) -> Kind:
    """Tell what a path is.

    Args:
        path: A tar, a pattern of tars, or a folder; a data set's folder may be the one given or lie in it.

    Raises:
        FileNotFoundError: There is nothing at the path.
        ValueError: It is none of these, or more than one.
    """
    text = str(path)
    if text.endswith(".tar") or "{" in text or "*" in text:
        return Kind.TARS
    folder = Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(
            f"nothing that could be a data set at {folder}: expected tars (a file, a folder, or a pattern "
            "such as 'DexYCB_mv_test-{000000..000003}.tar'), the folder of a raw data set, or a capture"
        )
    found = [kind for kind in Kind if _is(kind, folder)]
    if not found and _holds_calibration(folder):
        return Kind.CAPTURE
    if len(found) == 1:
        return found[0]
    which = f"could be {' or '.join(found)}" if found else "is none that is known"
    raise ValueError(
        f"{folder} {which}: say --kind, one of {', '.join(Kind)}; it holds {_contents(folder) or 'nothing'}"
    )


def source_at(path: str | Path, kind: Kind, *, split: str | None, mano: str | Path | None) -> FramesSource:
    """Describe the source at a path; `open()` of what is returned opens it.

    Args:
        path: See `recognise`.
        kind: What it is.
        split: None = the paper's training set; tars say theirs in their names.
        mano: The user's MANO file.

    Raises:
        ValueError: A MANO file is needed and was not given, or a split was given and there is none.
    """
    root, hand = str(path), None if mano is None else str(mano)
    if kind is Kind.TARS:
        return ReleasedTarsSource((root,), split=split, mano=hand)
    if kind is Kind.CAPTURE:
        if split is not None:
            raise ValueError(f"a capture has no splits; got --split {split}")
        return CapturesSource((root,), mano=hand)
    split = training_split(kind) if split is None else split
    if kind is Kind.OAKINK:
        return OakInkSource(root, mano=hand, split=split)
    if kind is Kind.FREIHAND:
        return FreiHANDSource(root, mano=hand, split=split)
    if hand is None:
        raise ValueError(
            f"{kind} stores MANO's parameters and no vertices: give --mano MANO_RIGHT.pkl (from "
            "mano.is.tue.mpg.de)"
        )
    if kind in (Kind.HO3D_V2, Kind.HO3D_V3):
        return HO3DSource(root, hand, split=split, version=kind.removeprefix("ho3d-"))
    if kind is Kind.DEXYCB:
        return DexYCBSource(root, hand, split=split)
    if kind is Kind.ARCTIC:
        return ArcticSource(root, hand, split=split)
    return InterHandSource(root, hand, split=split)


def training_split(kind: Kind) -> str:
    """Return the split of a raw set that the paper trains on."""
    return "train+val" if kind is Kind.OAKINK else "train"


def _is(kind: Kind, folder: Path) -> bool:
    if kind is Kind.TARS:
        return any(not is_hidden(file) for file in folder.glob("*.tar"))
    if kind is Kind.CAPTURE:
        return any((folder / name).is_file() for name in RIG_FILES)
    places = (folder, *(folder / name for name in _NAMES[kind]))
    return any(_MARKS[kind](place) for place in places if place.is_dir())


def _holds_calibration(folder: Path) -> bool:
    """Tell whether frames and another tool's calibration lie there; raw sets hold such files too."""
    if not (folder / "frames").is_dir() and not any((folder / name).is_file() for name in LABEL_FILES):
        return False
    try:
        find_rig_file(folder)
    except FileNotFoundError:
        return False
    except ValueError:
        pass  # Several: opening the capture says so.
    return True


def _holds(*names: str) -> Callable[[Path], bool]:
    """Make a test for files or folders, all of which must be there."""
    return lambda place: all((place / name).exists() for name in names)


def _is_ho3d(suffix: str) -> Callable[[Path], bool]:
    """Make a test for HO-3D, whose version 2 has PNGs and version 3 JPEGs."""

    def holds(place: Path) -> bool:
        return (place / "train.txt").is_file() and any(place.glob(f"train/*/rgb/*{suffix}"))

    return holds


_MARKS: Mapping[Kind, Callable[[Path], bool]] = {
    Kind.DEXYCB: lambda place: any(place.glob("calibration/extrinsics_*")),
    Kind.HO3D_V2: _is_ho3d(".png"),
    Kind.HO3D_V3: _is_ho3d(".jpg"),
    Kind.OAKINK: _holds("image/anno", "image/stream_release_v2"),
    Kind.ARCTIC: lambda place: any(
        (place / f"{data}raw_seqs").is_dir() for data in ("", "data/", "arctic_data/data/")
    ),
    Kind.INTERHAND: lambda place: any(place.glob("annotations/*/InterHand2.6M_*_data.json")),
    Kind.FREIHAND: lambda place: (place / "training_xyz.json").is_file() or (place / "training/rgb").is_dir(),
}


def _contents(folder: Path) -> str:
    names = sorted(path.name for path in folder.iterdir())
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
