"""Find the hands in images: palms, regions about them, key points in each; MediaPipe Hands' way.

Pictures are cut out by OpenCV where the images lie, and both networks run on pictures of one size each: no
program depends on the size of an image or on how many hands it shows, and little travels to an accelerator.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.detection.landmark_network import INPUT_SIZE as LANDMARK_SIZE
from poem_jax.detection.landmark_network import Landmarks, landmark_network
from poem_jax.detection.palm_network import INPUT_SIZE as PALM_SIZE
from poem_jax.detection.palm_network import palm_network
from poem_jax.detection.palms import find_palms, letterbox
from poem_jax.detection.regions import Region, cut_out, into_image, overlap, region_of_hand, region_of_palm
from poem_jax.detection.stored_weights import landmark_weights, palm_weights
from poem_jax.io.compiler_options import cpu_options
from poem_jax.typing import Array, Float, UInt8

MIN_PRESENCE = 0.5
"""A region holds a hand if the network is surer of it than this."""
_SAME_PLACE = 0.5
"""Intersection over union above which two regions are of one hand; the later replaces the earlier."""
_RIGHT = 0.5
_LOOK_AGAIN = 10
"""Frames of a video after which palms are looked for though enough hands are followed."""
_MAX_SIDE = 2**15 - 2
"""Of an image, pixels: OpenCV takes pictures by places of 16 bits."""
_BATCH = 8
"""Pictures that a program takes on an accelerator."""


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


class HandTrackers:
    """Finds the hands in the frames of several cameras' videos; the cameras' pictures are worked on together.

    The hands of a camera's last frame say where to look; the palm network runs while fewer than `max_hands`
    are followed, and every tenth frame, lest a face be followed for ever.
    """

    def __init__(self, num_cameras: int, max_hands: int = 2) -> None:
        self._max_hands = max_hands
        self._last: list[list[Region]] = [[] for _ in range(num_cameras)]
        self._turns = [0] * num_cameras

    def find_hands(self, cameras: Sequence[int], images: Sequence[Array]) -> list[list[DetectedHand]]:
        """Find the hands in the next frames of some of the cameras.

        Args:
            cameras: Their numbers, each once.
            images: One of each; as for `find_hands`, errors too.

        Returns: the hands of every image.
        """
        _check(images, self._max_hands)
        hands = _look(images, [self._last[camera] for camera in cameras])
        again = []
        for place, camera in enumerate(cameras):
            self._turns[camera] += 1
            if len(hands[place]) < self._max_hands or self._turns[camera] % _LOOK_AGAIN == 0:
                again.append(place)
        if again:
            self._look_again(again, images, hands)
        for place, camera in enumerate(cameras):
            self._last[camera] = _without_doubles([region_of_hand(h.keypoints_px) for h in hands[place]])
        return hands

    def _look_again(
        self, places: Sequence[int], images: Sequence[Array], hands: list[list[DetectedHand]]
    ) -> None:
        """Look for palms in some of the images, where no hand is followed, and add what they give."""
        chosen = [images[place] for place in places]
        new = []
        for place, palms in zip(places, _regions_of_palms(chosen, self._max_hands), strict=True):
            followed = [region_of_hand(hand.keypoints_px) for hand in hands[place]]
            new.append(
                [region for region in palms if all(overlap(region, one) <= _SAME_PLACE for one in followed)]
            )
        for place, more in zip(places, _look(chosen, new), strict=True):
            # A face that was taken for a hand gives its place to a surer one.
            surest = sorted([*hands[place], *more], key=lambda hand: -hand.score)
            hands[place] = surest[: self._max_hands]


class HandTracker:
    """Finds the hands in the frames of a video of one camera, as `HandTrackers` does."""

    def __init__(self, max_hands: int = 2) -> None:
        self._trackers = HandTrackers(1, max_hands)

    def find_hands(self, image: Array) -> list[DetectedHand]:
        """Find the hands in the next frame; arguments and errors as `find_hands`."""
        (hands,) = self._trackers.find_hands([0], [image])
        return hands


def compile_programs() -> None:
    """Compile all that `find_hands` and the trackers may need, so that no image waits for it."""
    for program in (_palm_program(), _landmark_program()):
        program.compile()


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
        if max(shape) > _MAX_SIDE:
            raise ValueError(f"`images` must be at most {_MAX_SIDE} pixels wide and high; got {shape}")


def _regions_of_palms(images: Sequence[Array], max_hands: int) -> list[list[Region]]:
    """Return where hands may be in every image."""
    seen = _palm_program()([partial(letterbox, image) for image in images])
    regions = []
    for image, logits, guesses in zip(images, *seen, strict=True):
        palms = find_palms(logits, guesses, image.shape[:2])[:max_hands]
        regions.append(_without_doubles([region_of_palm(palm) for palm in palms]))
    return regions


def _look(images: Sequence[Array], regions: Sequence[Sequence[Region]]) -> list[list[DetectedHand]]:
    """Return the hands in the regions of every image."""
    places = [(number, region) for number, found in enumerate(regions) for region in found]
    hands: list[list[DetectedHand]] = [[] for _ in images]
    if not places:
        return hands
    pictures = [partial(cut_out, images[number], region) for number, region in places]
    seen = Landmarks(*_landmark_program()(pictures))
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


class _Program:
    """A network with its weights, compiled for one picture (CPU) or eight (accelerators) at a time."""

    def __init__(self, network: Any, weights: Any, size: int) -> None:
        """`size`: pixels along a side of its pictures."""

        def run(weights: Any, pictures: Array) -> Any:
            return network(weights, pictures.astype(jnp.float32) / 255)

        self._weights = jax.device_put(weights)
        self._size, self._network = size, run
        self._compiled: dict[bool, Any] = {}

    def __call__(self, pictures: Sequence[Callable[[], UInt8[Array, "size size 3"]]]) -> list[Array]:
        """Make the pictures and run the network on them; on a CPU several side by side, one thread each."""
        on_cpu = jax.default_backend() == "cpu"
        number = 1 if on_cpu else _BATCH
        groups = [pictures[start : start + number] for start in range(0, len(pictures), number)]
        beside_others = on_cpu and len(groups) > 1
        # Compiled before several threads ask for it.
        program = self._program(number, beside_others)
        run = partial(self._filled, program, number)
        if beside_others:
            with ThreadPoolExecutor(min(len(groups), os.cpu_count() or 1)) as pool:
                parts = list(pool.map(run, groups))
        else:
            parts = [run(group) for group in groups]
        return [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]

    def compile(self) -> None:
        """Compile it for one group of pictures, and for several side by side."""
        on_cpu = jax.default_backend() == "cpu"
        for beside_others in (False, True) if on_cpu else (False,):
            self._program(1 if on_cpu else _BATCH, beside_others)

    def _program(self, number: int, beside_others: bool) -> Any:
        """Return the compiled program, that takes one thread where several run side by side."""
        if beside_others not in self._compiled:
            options = cpu_options(one_thread=beside_others) if jax.default_backend() == "cpu" else None
            jitted = jax.jit(self._network, compiler_options=options)
            pictures = jax.ShapeDtypeStruct((number, self._size, self._size, 3), jnp.uint8)
            self._compiled[beside_others] = jitted.lower(self._weights, pictures).compile()
        return self._compiled[beside_others]

    def _filled(self, program: Any, number: int, group: Sequence[Callable[[], Array]]) -> list[Array]:
        """Run it on pictures repeated to the number that it takes."""
        made = [make() for make in group]
        filled = np.stack([*made, *made[-1:] * (number - len(made))])
        return [np.asarray(out)[: len(group)] for out in program(self._weights, filled)]


@cache
def _palm_program() -> _Program:
    return _Program(palm_network, palm_weights(), PALM_SIZE)


@cache
def _landmark_program() -> _Program:
    return _Program(landmark_network, landmark_weights(), LANDMARK_SIZE)
