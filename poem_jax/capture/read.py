"""The stage `read`: the photographs of each frame. An image that is lost costs its view, not the take."""

import logging
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from poem_jax.capture.frame import Frame, ImageProblem
from poem_jax.geometry.rig import Rig
from poem_jax.io.images import read_image
from poem_jax.typing import Array, UInt8

_log = logging.getLogger(__name__)


def read_images(
    frames: Iterable[Frame], rig: Rig, *, needed: bool = True, go_on: bool = True
) -> Iterator[Frame]:
    """Read the images of each frame, and note those that are missing or cannot be used.

    Args:
        frames: A stream; frames without results so far, or, where images are only drawn on, with them.
        rig: The cameras.
        needed: Whether hands are to be found in the images; then a camera that sees one must have an image.
        go_on: Whether to do without a needed image that is lost.

    Raises:
        FileNotFoundError, ValueError: A needed image is lost, and `go_on` is False.
    """
    for frame in frames:
        sees_hand = np.isfinite(frame.boxes_px).all(-1).any(0) & needed
        images: list[UInt8[Array, "h w 3"] | None] = []
        problems: list[ImageProblem] = []
        for view, path in enumerate(frame.image_files):
            try:
                images.append(_read_view(path, rig, view, frame.name, bool(sees_hand[view])))
            except (FileNotFoundError, ValueError) as error:
                if sees_hand[view] and not go_on:
                    raise
                images.append(None)
                problems.append(ImageProblem(bool(sees_hand[view]), error))
                _log.warning("frame %s: an image is left out: %s", frame.name, error)
        yield frame._replace(images=tuple(images), problems=tuple(problems))


def _read_view(
    path: Path | None, rig: Rig, view: int, frame: str, needed: bool
) -> UInt8[Array, "h w 3"] | None:
    if path is not None:
        width, height = rig.size_wh[view]
        return read_image(path, (int(width), int(height)))
    if not needed:
        return None
    camera = rig.names[view]
    raise FileNotFoundError(
        f"frame {frame}: camera '{camera}' has a box but no image; expected {camera}.jpg or .png "
        "(to leave the view out, give it NaN boxes)"
    )
