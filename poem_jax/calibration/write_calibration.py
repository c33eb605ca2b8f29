"""Write a rig in the format of another tool."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from poem_jax.calibration.anipose_toml import write_anipose
from poem_jax.calibration.colmap_text import write_colmap
from poem_jax.calibration.easymocap_files import write_easymocap
from poem_jax.calibration.kalibr_yaml import write_kalibr
from poem_jax.calibration.opencv_files import write_opencv
from poem_jax.calibration.openpose_xml import write_openpose
from poem_jax.calibration.panoptic_json import write_panoptic
from poem_jax.calibration.rig_json import write_rig
from poem_jax.calibration.transforms_json import write_transforms
from poem_jax.calibration.voxelpose_json import write_voxelpose
from poem_jax.geometry.rig import Rig


class _Writer(NamedTuple):
    write: Callable[[Path, Rig], object]
    suffixes: tuple[str, ...]
    """Of its file; () = it is a folder."""


_WRITERS = {
    "rig": _Writer(write_rig, (".json",)),
    "opencv": _Writer(write_opencv, (".yml", ".yaml", ".xml")),
    "anipose": _Writer(write_anipose, (".toml",)),
    "colmap": _Writer(write_colmap, ()),
    "nerfstudio": _Writer(write_transforms, (".json",)),
    "easymocap": _Writer(write_easymocap, ()),
    "panoptic": _Writer(write_panoptic, (".json",)),
    "voxelpose": _Writer(write_voxelpose, (".json",)),
    "kalibr": _Writer(write_kalibr, (".yaml", ".yml")),
    "openpose": _Writer(write_openpose, ()),
}
FORMATS = tuple(_WRITERS)
"""Names of the formats that are written."""


def write_calibration(path: str | os.PathLike, rig: Rig, format: str | None = None) -> Path:
    """Write a rig, so that `read_calibration` gives it back.

    Args:
        path: A file, or for `colmap`, `easymocap` and `openpose` a folder.
        rig: The cameras.
        format: One of `FORMATS`; None = by the ending of the file: .json is our rig.json, .toml anipose's,
            .yml, .yaml and .xml OpenCV's.

    Raises:
        ValueError: no such format, an ending of another, or a camera that the format cannot hold, by name.
    """
    path = Path(path)
    _writer(path, format).write(path, rig)
    return path


def files_written(path: str | os.PathLike, rig: Rig, format: str | None = None) -> list[Path]:
    """Return the files that `write_calibration` would make or replace, and write none of them.

    Raises: ValueError: as `write_calibration`.
    """
    path = Path(path)
    writer = _writer(path, format)
    with tempfile.TemporaryDirectory() as folder:
        writer.write(Path(folder, path.name) if writer.suffixes else Path(folder), rig)
        names = sorted(file.name for file in Path(folder).iterdir())
    return [(path.parent if writer.suffixes else path) / name for name in names]


def _writer(path: Path, format: str | None) -> _Writer:
    """Return what writes a format, if `path` can be one of it."""
    if format is None:
        format = next((name for name in FORMATS if path.suffix.lower() in _WRITERS[name].suffixes), None)
        if format is None:
            raise ValueError(
                f"{path}: its ending does not tell the format; give --format, one of {', '.join(FORMATS)}"
            )
    if format not in _WRITERS:
        raise ValueError(f"the format must be one of {', '.join(FORMATS)}; got {str(format)[:40]!r}")
    writer = _WRITERS[format]
    if writer.suffixes and path.suffix.lower() not in writer.suffixes:
        raise ValueError(f"{path}: a file of the format {format} ends with {' or '.join(writer.suffixes)}")
    if not writer.suffixes and path.exists() and not path.is_dir():
        raise ValueError(f"{path}: the format {format} is a folder of files, and this is a file")
    return writer
