"""A bank of background pictures, made from a seed: gradients, noise of several octaves, shapes, stripes.

Pictures are uint8, square, and drawn into crops by a random mirrored warp, so a small bank goes a long way.
"""

import cv2
import numpy as np

from poem_jax.typing import Array, UInt8

SIZE = 256
"""Side of a background, pixels."""


def make_backgrounds(seed: int, count: int) -> UInt8[Array, "count side side 3"]:
    """Draw `count` backgrounds; the same seed gives the same bank, and its first pictures whatever the
    count."""
    return np.stack([_background(np.random.default_rng((seed, index))) for index in range(count)])


def _background(rng: np.random.Generator) -> UInt8[Array, "side side 3"]:
    image = _gradient(rng)
    image = image + rng.uniform(0.1, 0.5) * _clouds(rng)
    image = np.ascontiguousarray(np.clip(image, 0, 1) * 255, dtype=np.uint8)
    for paint in rng.permutation(np.array([_shapes, _stripes, _tiles, _strokes], dtype=object)):
        if rng.random() < 0.5:
            paint(rng, image)
    grain = rng.normal(0, rng.uniform(0, 14), image.shape[:2])[..., None]
    return np.clip(image + grain, 0, 255).astype(np.uint8)


def _color(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a colour of 255, more often greyish than loud."""
    grey, hue = rng.uniform(0, 255), rng.uniform(0, 255, 3)
    r, g, b = grey + rng.beta(1, 2) * (hue - grey)
    return float(r), float(g), float(b)


def _gradient(rng: np.random.Generator) -> Array:
    """Return colours between four corners, in [0, 1]."""
    corners = np.array([_color(rng) for _ in range(4)], np.float32).reshape(2, 2, 3) / 255
    center = corners.mean((0, 1))
    corners = center + rng.uniform(0.3, 1.0) * (corners - center)
    return cv2.resize(corners.astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)


def _clouds(rng: np.random.Generator) -> Array:
    """Return noise of six octaves about 0, one roughness for all."""
    total, roughness = np.zeros((SIZE, SIZE, 3), np.float32), rng.uniform(0.4, 0.9)
    tint = rng.uniform(0, 0.6)
    for octave in range(6):
        cells = 3 * 2**octave
        noise = rng.normal(size=(cells, cells, 1)) + tint * rng.normal(size=(cells, cells, 3))
        layer = cv2.resize(noise.astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
        total += roughness**octave * layer
    return total / 2


def _shapes(rng: np.random.Generator, image: Array) -> None:
    for _ in range(rng.integers(3, 25)):
        center = rng.integers(0, SIZE, 2)
        if rng.random() < 0.5:
            corners = center + rng.integers(-70, 71, (rng.integers(3, 7), 2))
            cv2.fillPoly(image, [cv2.convexHull(corners.astype(np.int32))], _color(rng), cv2.LINE_AA)
        else:
            axes = rng.integers(4, 60, 2).tolist()
            cv2.ellipse(
                image, center.tolist(), axes, rng.uniform(0, 180), 0, 360, _color(rng), -1, cv2.LINE_AA
            )


def _stripes(rng: np.random.Generator, image: Array) -> None:
    across = np.arange(SIZE) + rng.uniform(-2, 2) * np.arange(SIZE)[:, None]
    wave = np.sin(across * rng.uniform(0.03, 0.8) + rng.uniform(0, 6)) > rng.uniform(-0.6, 0.9)
    where = (wave & _region(rng))[..., None]
    image[:] = np.where(where, (0.4 * image + 0.6 * np.array(_color(rng))).astype(np.uint8), image)


def _tiles(rng: np.random.Generator, image: Array) -> None:
    side = rng.integers(8, 60, 2)
    column, row = np.arange(SIZE) // side[0], np.arange(SIZE)[:, None] // side[1]
    where = (((column + row) % 2 == 0) & _region(rng))[..., None]
    image[:] = np.where(where, (0.5 * image + 0.5 * np.array(_color(rng))).astype(np.uint8), image)


def _strokes(rng: np.random.Generator, image: Array) -> None:
    """Draw lines, some as long and thick as fingers and some of their colour."""
    for _ in range(rng.integers(5, 40)):
        ends = rng.integers(0, SIZE, (2, 2)).tolist()
        cv2.line(image, ends[0], ends[1], _color(rng), int(rng.integers(1, 14)), cv2.LINE_AA)


def _region(rng: np.random.Generator) -> Array:
    """Return a half-plane mask, so that a pattern does not always fill the picture."""
    slope = rng.normal(size=2)
    offset = rng.uniform(-0.2, 1.2) * SIZE * np.abs(slope).sum()
    grid = np.arange(SIZE)
    return grid * slope[0] + grid[:, None] * slope[1] < offset
