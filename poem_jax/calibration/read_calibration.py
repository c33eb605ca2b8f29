"""Read the calibration of a rig from any file or folder that is known, told apart by content.

A format is recognised by the names of its entries, so that files may have any name, and a broken one is
described as what it was meant to be.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from poem_jax.calibration.anipose_toml import is_anipose, kind_of, read_anipose
from poem_jax.calibration.assemble import Calibration, rig_of
from poem_jax.calibration.assemblyhands_json import is_assemblyhands, read_assemblyhands
from poem_jax.calibration.colmap_text import colmap_part, is_colmap, read_colmap
from poem_jax.calibration.documents import Document, Syntax, read_document
from poem_jax.calibration.easymocap_files import easymocap_part, is_easymocap, read_easymocap
from poem_jax.calibration.kalibr_yaml import is_kalibr, read_kalibr
from poem_jax.calibration.opencv_files import is_opencv, opencv_part, read_opencv
from poem_jax.calibration.openpose_xml import is_openpose, read_openpose
from poem_jax.calibration.other_kinds import OTHER_KINDS
from poem_jax.calibration.panoptic_json import is_panoptic, read_panoptic
from poem_jax.calibration.rig_json import is_rig, read_rig
from poem_jax.calibration.stereo_dat import is_stereo_dat, read_stereo_dat
from poem_jax.calibration.transforms_json import is_transforms, read_transforms
from poem_jax.calibration.voxelpose_json import is_voxelpose, read_voxelpose
from poem_jax.geometry.rig import Rig

SUFFIXES = (".json", ".toml", ".yml", ".yaml", ".xml", ".txt", ".dat", ".xcp")
"""Of files that are looked at in a folder."""
_MOST_FILES = 500
_MOST_BYTES = 2**23


class Format(NamedTuple):
    """How a format is told from others, and read."""

    name: Callable[[Document], str]
    recognise: Callable[[Document], bool]
    read: Callable[[Sequence[Document]], Calibration]
    part: Callable[[Document], object] | None = None
    """Of formats of several files: which of them one is; None = one file holds all."""


def _called(name: str) -> Callable[[Document], str]:
    return lambda _: name


def _one(read: Callable[[Document], Calibration]) -> Callable[[Sequence[Document]], Calibration]:
    return lambda documents: read(documents[0])


FORMATS_READ = (
    Format(kind_of, is_anipose, _one(read_anipose)),
    Format(_called("transforms.json of nerfstudio or instant-ngp"), is_transforms, _one(read_transforms)),
    Format(_called("Panoptic's JSON"), is_panoptic, _one(read_panoptic)),
    Format(_called("VoxelPose's JSON"), is_voxelpose, _one(read_voxelpose)),
    Format(_called("AssemblyHands's JSON"), is_assemblyhands, _one(read_assemblyhands)),
    Format(_called("Kalibr's YAML"), is_kalibr, _one(read_kalibr)),
    Format(_called("COLMAP's text"), is_colmap, read_colmap, colmap_part),
    Format(_called("EasyMocap's YAML"), is_easymocap, read_easymocap, easymocap_part),
    Format(_called("OpenPose's XML"), is_openpose, read_openpose, lambda document: document.path.stem),
    Format(_called("OpenCV's file"), is_opencv, read_opencv, opencv_part),
    Format(
        _called("TemugeB's .dat files"), is_stereo_dat, read_stereo_dat, lambda document: document.path.stem
    ),
)
KNOWN = (
    "our rig.json, OpenCV's YAML and XML, the TOML of anipose, freemocap, Pose2Sim and caliscope, COLMAP's "
    "text, transforms.json, EasyMocap's intri and extri, Panoptic's, VoxelPose's and AssemblyHands's JSON, "
    "Kalibr's camchain, OpenPose's XML, and TemugeB's .dat files"
)


def read_calibration(
    path: str | os.PathLike,
    *,
    unit: str | float | None = None,
    image_size: tuple[int, int] | None = None,
) -> Rig:
    """Read the calibration of a rig, whichever tool wrote it.

    Args:
        path: A file; or a folder that holds one calibration, of one file or of those of one format. Of a
            format of several files any of them may be given; the others are looked for beside it.
        unit: Of its lengths, as `units.metres_of` takes it; None = what the file says, else what is
            customary, which is logged.
        image_size: Width and height of all images, for formats that do not hold it; those that do must agree.

    Returns: The rig, in metres and in pixels where the image spans [0, W] x [0, H].

    Raises:
        FileNotFoundError: no such file or folder, or no calibration in the folder.
        ValueError: it is of no kind that is read, is broken, or is several calibrations. The message names
            the file, what it seems to be, and what to do.
    """
    path = Path(path)
    if path.is_dir():
        documents = _one_calibration(path)
    else:
        documents = [read_document(path)]
        kind = _format(documents[0])
        if kind is not None and kind.part is not None:
            documents += _siblings(documents[0], kind)
    document = documents[0]
    if is_rig(document):
        return read_rig(document.path, unit=unit, size_wh=image_size)
    kind = _format(document)
    if kind is None:
        raise ValueError(_unknown(document))
    name = kind.name(document)
    try:
        found = kind.read(documents)
        return rig_of(found, document.path, name, unit=unit, size_wh=image_size)
    except ValueError as error:
        raise ValueError(f"{error} (this looks like {name}, and was read as such)") from error


def find_calibrations(folder: str | os.PathLike) -> list[list[Path]]:
    """Return the calibrations of a folder, not those below it; of a format of several files the files of one.

    Files that cannot be read as text, or are of no kind that is read, are passed over.
    """
    return [[document.path for document in group] for group in _calibrations(Path(folder))]


def _one_calibration(folder: Path) -> list[Document]:
    found = _calibrations(folder)
    if len(found) == 1:
        return found[0]
    if not found:
        if (folder / "cameras.bin").is_file():
            raise ValueError(
                f"{folder} holds COLMAP's binary files: make them text by `colmap model_converter "
                f"--input_path {folder} --output_path {folder} --output_type TXT`"
            )
        raise FileNotFoundError(f"no calibration in {folder}: expected a file of {KNOWN}")
    names = "; ".join(", ".join(document.path.name for document in group[:3]) for group in found[:8])
    raise ValueError(f"{folder} holds {len(found)} calibrations: {names}; give the one that is meant")


def _calibrations(folder: Path) -> list[list[Document]]:
    """Return what is recognised in a folder: each file alone, or with the others of its format."""
    alone: list[list[Document]] = []
    together: dict[int, list[Document]] = {}
    for document in _documents(folder):
        if is_rig(document):
            alone.append([document])
            continue
        for number, kind in enumerate(FORMATS_READ):
            if kind.recognise(document):
                if kind.part is None:
                    alone.append([document])
                else:
                    together.setdefault(number, []).append(document)
                break
    for number, documents in together.items():
        part = FORMATS_READ[number].part
        assert part is not None
        parts = [part(document) for document in documents]
        groups = [documents] if len(set(parts)) == len(parts) else [[document] for document in documents]
        alone += groups
    return alone


def _documents(folder: Path) -> list[Document]:
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    documents = []
    for path in paths[:_MOST_FILES]:
        if path.name.startswith(".") or path.stat().st_size > _MOST_BYTES:
            continue
        try:
            documents.append(read_document(path))
        except ValueError:
            # What is no text is no calibration, and may lie here all the same.
            continue
    return documents


def _siblings(document: Document, kind: Format) -> list[Document]:
    """Return the other files of a format that lie beside one, where they are one of each part."""
    assert kind.part is not None
    own = kind.part(document)
    others = [
        other
        for other in _documents(document.path.parent)
        if other.path.name != document.path.name and kind.recognise(other) and kind.part(other) != own
    ]
    if own == "cameras" and kind.recognise is is_opencv:
        return []
    parts = [kind.part(other) for other in others]
    twice = next((part for part in parts if parts.count(part) > 1), None)
    if twice is not None:
        names = ", ".join(other.path.name for other, part in zip(others, parts, strict=True) if part == twice)
        raise ValueError(
            f"{document.path} is a part of a calibration, and beside it lie several that would make it "
            f"whole: {names}; put the two that belong together into a folder of their own"
        )
    return others


def _format(document: Document) -> Format | None:
    return next((kind for kind in FORMATS_READ if kind.recognise(document)), None)


def _unknown(document: Document) -> str:
    for kind in OTHER_KINDS:
        if kind.recognise(document):
            return f"{document.path} looks like {kind.name}: {kind.advice}"
    if document.syntax not in (Syntax.LINES, Syntax.XML):
        document.content()  # What is broken says so, and where.
    keys = ", ".join(sorted(document.keys)[:12]) or "no names"
    return (
        f"{document.path} is no calibration that is known: it is {document.syntax.value} with {keys}; read "
        f"are {KNOWN}"
    )
