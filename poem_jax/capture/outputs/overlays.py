"""The meshes drawn over the photographs: one PNG a frame and camera, or one video a camera."""

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.capture.frame import Frame
from poem_jax.capture.frame_times import SECONDS_PER_FRAME
from poem_jax.data.lens import project_raw
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float, Int, UInt8
from poem_jax.viz.overlay import MeshInView, draw_overlay
from poem_jax.viz.page import HAND_RGB

_CODEC = "mp4v"


class Drawn(NamedTuple):
    """How a hand is drawn."""

    faces: Int[Array, "face 3"]
    side: str


def draw_views(
    frame: Frame, rig: Rig, vertices: Mapping[str, Float[Array, "778 3"]], hands: Mapping[str, Drawn]
) -> list[UInt8[Array, "_ _ 3"] | None]:
    """Return each photograph of a frame with its meshes, by the hands' names, on it; None = no image."""
    drawn: list[UInt8[Array, "_ _ 3"] | None] = []
    for view, image in enumerate(frame.images):
        if image is None:
            drawn.append(None)
            continue
        meshes = [
            MeshInView(*project_raw(rig, view, mesh), hands[name].faces, HAND_RGB[hands[name].side])
            for name, mesh in vertices.items()
        ]
        drawn.append(draw_overlay(image, meshes))
    return drawn


def write_png(path: Path, image: UInt8[Array, "h w 3"]) -> Path:
    """Write an RGB image."""
    with whole_file(path) as temporary:
        ok, data = cv2.imencode(".png", image[..., ::-1])
        if not ok:
            raise OSError(f"cannot encode {path} as PNG")
        temporary.write_bytes(data.tobytes())
    return path


class OverlayVideos:
    """One video a camera, written frame by frame; each appears whole at the end, or not at all."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Prepare videos; a camera that never has an image gets none.

        Args:
            paths: One per camera, ending in `.mp4`.
        """
        self._videos = [_Video(path) for path in paths]
        self._waiting: list[UInt8[Array, "_ _ 3"] | None] | None = None
        self._first_s: float | None = None
        self._rate: float | None = None

    def add(self, time_s: float | None, images: Sequence[UInt8[Array, "_ _ 3"] | None]) -> None:
        """Append a frame; a camera without an image is grey in it.

        The rate is that of the first two frames, by their times in seconds, or 30 a second.

        Raises: OSError: A video cannot be begun.
        """
        if self._rate is None:
            if self._waiting is None:
                self._waiting, self._first_s = list(images), time_s
                return
            self._begin(time_s)
        self._append(images)

    def finish(self) -> list[Path]:
        """Close the videos and give them their names.

        Raises: OSError: A video does not hold all its frames: the disk is full, for one.
        """
        if self._rate is None and self._waiting is not None:
            self._begin(None)
        return [path for video in self._videos if (path := video.finish()) is not None]

    def close(self) -> None:
        """Let go of what is not finished."""
        for video in self._videos:
            video.close()

    def _begin(self, second_s: float | None) -> None:
        known = self._first_s is not None and second_s is not None and second_s > self._first_s
        self._rate = 1 / (second_s - self._first_s) if known else 1 / SECONDS_PER_FRAME  # pyright: ignore
        assert self._waiting is not None
        self._append(self._waiting)
        self._waiting = None

    def _append(self, images: Sequence[UInt8[Array, "_ _ 3"] | None]) -> None:
        assert self._rate is not None
        for video, image in zip(self._videos, images, strict=True):
            video.append(image, self._rate)


class _Video:
    """A video of a camera, begun with its first image."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = ExitStack()
        self._writer: cv2.VideoWriter | None = None
        self._temporary = path
        self._grey: UInt8[np.ndarray, "h w 3"] = np.zeros((1, 1, 3), np.uint8)
        self._count = 0

    def append(self, image: UInt8[Array, "h w 3"] | None, rate: float) -> None:
        """Append an RGB image, or a grey one for None."""
        if image is not None and self._writer is None:
            self._begin(image, rate)
        self._count += 1
        if self._writer is not None:
            self._writer.write(self._grey if image is None else np.ascontiguousarray(image[..., ::-1]))

    def finish(self) -> Path | None:
        """Return the finished file, None if there was no image."""
        if self._writer is None:
            return None
        self._writer.release()
        found = _frames_in(self._temporary)
        if found != self._count:
            raise OSError(
                f"{self._path} cannot be written: {found} of its {self._count} frames arrived; "
                "is the disk full?"
            )
        self._file.close()
        self._writer = None
        return self._path

    def close(self) -> None:
        """Remove the file if it is not finished."""
        if self._writer is not None:
            self._writer.release()
            self._writer = None
            self._file.__exit__(RuntimeError, RuntimeError("not finished"), None)

    def _begin(self, image: UInt8[Array, "h w 3"], rate: float) -> None:
        self._temporary = self._file.enter_context(whole_file(self._path))
        height, width = image.shape[:2]
        codec = cv2.VideoWriter.fourcc(*_CODEC)
        self._writer = cv2.VideoWriter(os.fspath(self._temporary), codec, rate, (width, height))
        if not self._writer.isOpened():
            raise OSError(
                f"{self._path} cannot be written: OpenCV opens no {_CODEC} video there; "
                "--formats png writes images"
            )
        self._grey = np.full_like(image, 128)
        for _ in range(self._count):
            self._writer.write(self._grey)


def _frames_in(path: Path) -> int:
    video = cv2.VideoCapture(os.fspath(path))
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    video.release()
    return count
