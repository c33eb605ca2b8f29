"""Find the hands in images: palms, regions about them, key points in each; MediaPipe Hands' way.

Pictures are cut out by OpenCV where the images lie, and both networks run on pictures of one size each: no
program depends on the size of an image or on how many hands it shows, and little travels to an accelerator.
"""

from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.detection.landmark_network import Landmarks, landmark_network
from poem_jax.detection.palm_network import palm_network
from poem_jax.detection.palms import find_palms, letterbox
from poem_jax.detection.regions import Region, cut_out, into_image, overlap, region_of_hand, region_of_palm
from poem_jax.detection.stored_weights import landmark_weights, palm_weights
from poem_jax.typing import Array, Float, UInt8

MIN_PRESENCE = 0.5
"""A region holds a hand if the network is surer of it than this."""
_SAME_PLACE = 0.5
"""Intersection over union above which two regions are of one hand; the later replaces the earlier."""
_RIGHT = 0.5
_BATCHES = (1, 8)
"""Pictures that a program takes: there is one program for each size and network."""


class DetectedHand(NamedTuple):
    """A hand in an image."""

    keypoints_px: Float[Array, "21 2"]
    """OpenPose order, pixels of the image, which spans [0, W] x [0, H]; some may lie outside of it."""
    side: str
    """Of the person: `right` or `left`."""
    side_score: float
    """How sure the network is of the side, 0.5 to 1."""
    score: float
    """How sure the network is that this is a hand, 0.5 to 1."""


def find_hands(images: Sequence[Array], *, max_hands: int = 2) -> list[list[DetectedHand]]:
    """Find the hands in every image by itself.

    Args:
        images: RGB (h, w, 3) of uint8, of any sizes, not mirrored.
        max_hands: Hands looked for in one image, the surest palms first.

    Returns: the hands of every image, none where there is none.

    Raises:
        ValueError: An image is not (h, w, 3) of uint8; `max_hands` is not positive.
    """
    _check(images, max_hands)
    return _look(images, _regions_of_palms(images, max_hands))


class HandTracker:
    """Finds the hands in the frames of a video of one camera.

    The hands of the last frame say where to look; the palm network runs only while fewer than `max_hands` are
    followed.
    """

    def __init__(self, max_hands: int = 2) -> None:
        self._max_hands = max_hands
        self._last: list[Region] = []

    def find_hands(self, image: Array) -> list[DetectedHand]:
        """Find the hands in the next frame; arguments and errors as `find_hands`."""
        _check([image], self._max_hands)
        regions = self._last
        if len(regions) < self._max_hands:
            (new,) = _regions_of_palms([image], self._max_hands)
            regions = _without_doubles([*new, *regions])[: self._max_hands]
        (hands,) = _look([image], [regions])
        self._last = _without_doubles([region_of_hand(hand.keypoints_px) for hand in hands])
        return hands


def _check(images: Sequence[Any], max_hands: int) -> None:
    if max_hands < 1:
        raise ValueError(f"`max_hands` must be 1 or more; got {max_hands}")
    for index, image in enumerate(images):
        shape, dtype = getattr(image, "shape", None), getattr(image, "dtype", None)
        if shape is None or len(shape) != 3 or shape[2] != 3 or 0 in shape or dtype != np.uint8:
            raise ValueError(
                f"`images` must be RGB arrays (h, w, 3) of uint8; number {index} has shape {shape} and dtype "
                f"{dtype}"
            )


def _regions_of_palms(images: Sequence[Array], max_hands: int) -> list[list[Region]]:
    """Return where hands may be in every image."""
    pictures = [letterbox(image) for image in images]
    regions = []
    for image, logits, guesses in zip(images, *_run(_palm_program(), pictures), strict=True):
        palms = find_palms(logits, guesses, image.shape[:2])[:max_hands]
        regions.append(_without_doubles([region_of_palm(palm) for palm in palms]))
    return regions


def _look(images: Sequence[Array], regions: Sequence[Sequence[Region]]) -> list[list[DetectedHand]]:
    """Return the hands in the regions of every image."""
    places = [(number, region) for number, found in enumerate(regions) for region in found]
    hands: list[list[DetectedHand]] = [[] for _ in images]
    if not places:
        return hands
    pictures = [cut_out(images[number], region) for number, region in places]
    seen = Landmarks(*_run(_landmark_program(), pictures))
    for (number, region), points, presence, right in zip(places, *seen, strict=True):
        if presence > MIN_PRESENCE:
            side = "right" if right > _RIGHT else "left"
            keypoints = into_image(points[:, :2].astype(float), region)
            sure = float(max(right, 1 - right))
            hands[number].append(DetectedHand(keypoints, side, sure, float(presence)))
    return hands


def _without_doubles(regions: Sequence[Region]) -> list[Region]:
    """Leave out regions at the place of a later one."""
    return [
        region
        for number, region in enumerate(regions)
        if all(overlap(region, later) <= _SAME_PLACE for later in regions[number + 1 :])
    ]


def _run(program: Any, pictures: Sequence[UInt8[Array, "size size 3"]]) -> list[Array]:
    """Run a network on pictures; on a CPU one on each thread, elsewhere in batches."""
    size = _BATCHES[0] if jax.default_backend() == "cpu" else _BATCHES[1]
    groups = [pictures[start : start + size] for start in range(0, len(pictures), size)]

    def run(group: Sequence[Array]) -> list[Array]:
        filled = [*group, *[group[-1]] * (size - len(group))]
        return [np.asarray(out)[: len(group)] for out in program(np.stack(filled))]

    return [np.concatenate(parts) for parts in zip(*map(run, groups), strict=True)]


@cache
def _palm_program() -> Any:
    return _compiled(palm_network, palm_weights())


@cache
def _landmark_program() -> Any:
    return _compiled(landmark_network, landmark_weights())


def _compiled(network: Any, weights: Any) -> Any:
    run = jax.jit(lambda weights, pictures: network(weights, pictures.astype(jnp.float32) / 255))
    return partial(run, jax.device_put(weights))
