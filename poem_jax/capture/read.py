"""The stage `read`: the photographs of each frame. An image that is lost costs its view, not the take.

The next frames are read in a thread while the caller works on this one.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import combinations

import cv2
import numpy as np

from poem_jax.capture.frame import Frame, ImageProblem
from poem_jax.geometry.rig import Rig
from poem_jax.io.images import read_image
from poem_jax.io.reading_ahead import read_ahead
from poem_jax.io.video import ImageSource, VideoFrame
from poem_jax.typing import Array, Float, UInt8

_SMALL_PX = 64
_ONE_COLOUR, _SAME = 4.0, 8.0
"""Levels of 255 in an image in small; compressing it again changes few by more than 3."""

ReadView = UInt8[Array, "_ _ 3"] | FileNotFoundError | ValueError | None
"""The image of a view, or why there is none; None = no image was expected."""

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
    for frame, views in read_ahead(frames, partial(_views_of, rig=rig)):
        sees_hand = np.isfinite(frame.boxes_px).all(-1).any(0) & needed
        images: list[UInt8[Array, "h w 3"] | None] = []
        problems: list[ImageProblem] = []
        for view, image in enumerate(views):
            if image is None and sees_hand[view]:
                image = _no_image(rig.names[view], frame.name)
            if isinstance(image, FileNotFoundError | ValueError):
                if sees_hand[view] and not go_on:
                    raise image
                problems.append(ImageProblem(bool(sees_hand[view]), image))
                _log.warning("frame %s: an image is left out: %s", frame.name, image)
            images.append(image if isinstance(image, np.ndarray) else None)
        frame = frame._replace(images=tuple(images), problems=tuple(problems))
        yield with_odd_images_told(frame, rig) if needed else frame


def read_views(sources: Sequence[ImageSource | None], rig: Rig) -> list[ReadView]:
    """Read the images of one moment, of the sizes for which the cameras were calibrated."""
    return [None if source is None else _read_view(source, rig, view) for view, source in enumerate(sources)]


def _read_view(source: ImageSource, rig: Rig, view: int) -> ReadView:
    width, height = rig.size_wh[view]
    size_wh = int(width), int(height)
    try:
        return source.read(size_wh) if isinstance(source, VideoFrame) else read_image(source, size_wh)
    except (FileNotFoundError, ValueError) as error:
        return error


def _views_of(frame: Frame, rig: Rig) -> list[ReadView]:
    return read_views(frame.image_files, rig)


def _no_image(camera: str, frame: str) -> FileNotFoundError:
    return FileNotFoundError(
        f"frame {frame}: camera '{camera}' has a box but no image; expected {camera}.jpg or .png "
        "(to leave the view out, give it NaN boxes)"
    )


def with_odd_images_told(frame: Frame, rig: Rig) -> Frame:
    """Leave out images that show nothing, and warn of those that are the same.

    One colour is that of a covered lens or a lost connection, and two cameras never take the same picture.
    """
    images, problems, warnings = list(frame.images), list(frame.problems), list(frame.warnings)
    small = {view: _in_small(image) for view, image in enumerate(images) if image is not None}
    for view in [view for view, picture in small.items() if np.ptp(picture) < _ONE_COLOUR]:
        del small[view]
        images[view] = None
        said = f"the image of camera '{rig.names[view]}' shows nothing but one colour: it is left out"
        problems.append(ImageProblem(False, ValueError(f"frame {frame.name}: {said}")))
        warnings.append(said)
    for a, b in combinations(small, 2):
        if small[a].shape == small[b].shape and np.abs(small[a] - small[b]).max() < _SAME:
            warnings.append(
                f"cameras '{rig.names[a]}' and '{rig.names[b]}' have the same image: one is a copy; give "
                "each camera its own. The hands are not to be trusted"
            )
    return frame._replace(images=tuple(images), problems=tuple(problems), warnings=tuple(warnings))


def _in_small(image: UInt8[Array, "h w 3"]) -> Float[Array, "_ _"]:
    """Return an image in grey, in which the traces of a compression are averaged away."""
    longer = max(image.shape[:2])
    width, height = (max(1, round(_SMALL_PX * side / longer)) for side in image.shape[1::-1])
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
