"""Markers as TRC (track row column), the text that OpenSim and Motive exchange: times, and places in mm."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float


def write_trc(
    path: Path,
    markers: Sequence[str],
    time_s: Float[Array, " frame"],
    points_mm: Float[Array, "frame marker 3"],
    frames_per_second: float,
) -> Path:
    """Write markers; the file appears whole or not at all.

    Args:
        path: The file.
        markers: Names without tabs.
        time_s: Of the frames.
        points_mm: Millimetres, y up; NaN = not there, an empty cell.
        frames_per_second: The usual rate.
    """
    frames, rate = len(time_s), f"{frames_per_second:.6g}"
    fields = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
    values = [rate, rate, frames, len(markers), "mm", rate, 1, frames]
    axes = [f"{axis}{number}" for number in range(1, len(markers) + 1) for axis in "XYZ"]
    head = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        fields.split(),
        [str(value) for value in values],
        ["Frame#", "Time", *(cell for name in markers for cell in (name, "", ""))],
        ["", "", *axes],
        [],
    ]
    with whole_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines("\t".join(row) + "\n" for row in head)
        for number, (time, points) in enumerate(zip(time_s, points_mm, strict=True), 1):
            cells = (f"{value:.4f}" if np.isfinite(value) else "" for value in points.ravel())
            stream.write("\t".join([str(number), f"{time:.6f}", *cells]) + "\n")
    return path
