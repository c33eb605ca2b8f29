"""The file that HO-3D's official evaluation takes: `pred.json` in a zip, one hand for every image.

Layout of the authors' `pred.py` (github.com/shreyashampali/ho3d): `[joints, vertices]`, two lists with a row
for each line of `evaluation.txt`, in its order; metres, OpenGL camera axes (y up, z backwards); 21 joints in
MANO's order with the tips last, thumb to little, and 778 vertices.
"""

import json
import os
import zipfile
from collections.abc import Iterator, Sequence

import numpy as np

from poem_jax.hand.topology import NUM_JOINTS, NUM_VERTICES, OPENPOSE_FROM_MANO
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Float

MANO_FROM_OPENPOSE = tuple(np.argsort(OPENPOSE_FROM_MANO).tolist())
_OPENGL_FROM_OPENCV = np.array([1.0, -1.0, -1.0])
_DECIMALS = 6
"""Of metres."""


class Ho3dSubmission:
    """Hands by the lines of the list of images."""

    def __init__(self, num_images: int) -> None:
        self._joints = np.full((num_images, NUM_JOINTS, 3), np.nan, np.float32)
        self._vertices = np.full((num_images, NUM_VERTICES, 3), np.nan, np.float32)

    def add(
        self, row: int, joints_cam: Float[np.ndarray, "21 3"], vertices_cam: Float[np.ndarray, "778 3"]
    ) -> None:
        """Take the hand of one image.

        Args:
            row: line of `evaluation.txt`, from 0.
            joints_cam: metres, OpenCV axes of the image's camera, OpenPose order.
            vertices_cam: likewise.
        """
        self._joints[row] = joints_cam[list(MANO_FROM_OPENPOSE)] * _OPENGL_FROM_OPENCV
        self._vertices[row] = vertices_cam * _OPENGL_FROM_OPENCV

    @property
    def missing(self) -> Sequence[int]:
        """Lines that have no hand yet."""
        return np.flatnonzero(~np.isfinite(self._joints).all((1, 2))).tolist()

    def write(self, path: str | os.PathLike) -> None:
        """Write the zip; it appears whole or not at all.

        Raises:
            ValueError: an image has no hand; the official evaluation wants all.
        """
        if missing := self.missing:
            raise ValueError(
                f"a submission needs a hand for each of {len(self._joints)} images, and {len(missing)} have "
                f"none; the first is line {missing[0] + 1} of evaluation.txt"
            )
        with (
            whole_file(path) as file,
            zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
            archive.open("pred.json", "w", force_zip64=True) as stream,
        ):
            for start, rows in ((b"[", self._joints), (b",", self._vertices)):
                stream.write(start)
                stream.writelines(_json_of(rows))
            stream.write(b"]")


def _json_of(rows: Float[np.ndarray, "image point 3"]) -> Iterator[bytes]:
    """Yield a list of rows piece by piece: the text of all is several times as large as the numbers."""
    for number, row in enumerate(rows.astype(np.float64).round(_DECIMALS)):
        yield b"," if number else b"["
        yield json.dumps(row.tolist()).encode()
    yield b"]"
