"""A take as a labelled capture: photographs, rig and hands in one folder, to train a model on."""

import logging
import shutil
from pathlib import Path

import cv2
import numpy as np

from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture.frame import Frame
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.world_origin import move_origin
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float, UInt8

_log = logging.getLogger(__name__)

FRAMES = "frames"
_QUALITY = 95
"""Of the JPEGs: artefacts of the videos themselves are larger."""


class LabelledCapture:
    """The folder of such a capture, written frame by frame; see docs/training.md."""

    def __init__(self, folder: Path, rig: Rig, origin_world: Float[Array, "3"]) -> None:
        """Prepare it.

        Args:
            folder: Of the capture.
            rig: The cameras, in the world whose origin is `origin_world`.
            origin_world: Where that origin lies in the world of the labels.
        """
        self._folder, self._names = folder, rig.names
        self._empty = True
        self._rig = rig._replace(T_cam_from_world=move_origin(rig.T_cam_from_world, -origin_world))

    def add(self, frame: Frame) -> None:
        """Write the photographs of a frame, as the cameras took them."""
        if not frame.images:
            return
        for camera, image in zip(self._names, frame.images, strict=True):
            if image is not None:
                self._empty = False
                _write_jpeg(self._folder / FRAMES / frame.name / f"{camera}.jpg", image)

    def finish(self, labels: Path) -> list[Path]:
        """Write the rig, and the hands that were found as the labels; return both files.

        Nothing is written, and a warning given, of a take without photographs.
        """
        if self._empty:
            _log.warning("the take has no photographs: %s is not written", self._folder)
            return []
        rig = self._folder / "rig.json"
        write_rig(rig, self._rig)
        with whole_file(self._folder / labels.name) as temporary:
            shutil.copyfile(labels, temporary)
        return [rig, self._folder / labels.name]


def _write_jpeg(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    with whole_file(path) as temporary:
        ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if not ok:
            raise OSError(f"cannot encode {path} as JPEG")
        temporary.write_bytes(data.tobytes())
