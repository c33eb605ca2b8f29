"""How materials look at a point: colour, unevenness, gloss. Arrays are per sample; colours linear RGB."""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.geometry.transforms import unit_vectors
from poem_jax.synthetic.desk.surface import Material
from poem_jax.typing import Array, Float, Int

_TEXTURE = 1024
_WOOD_M = 0.8
"""Side of the wood's texture."""


class Painted(NamedTuple):
    """What a surface does with light."""

    color: Float[Array, "sample 3"]
    normals: Float[Array, "sample 3"]
    gloss: Float[Array, " sample"]
    """Strength of the highlight."""
    sharpness: Float[Array, " sample"]
    """Its exponent (Blinn 1977)."""


def paint(
    material: Int[Array, " sample"],
    color: Float[Array, "sample 3"],
    local: Float[Array, "sample 3"],
    normals: Float[Array, "sample 3"],
) -> Painted:
    """Return what the samples of every material look like."""
    color, normals = color.copy(), normals.copy()
    gloss, sharpness = (np.full(len(color), value, np.float32) for value in (0.02, 12.0))
    for kind in np.unique(material):
        at = np.flatnonzero(material == kind)
        if kind == Material.SKIN:
            factor, bump = _skin(local[at])
            color[at] *= factor
            normals[at] = unit_vectors(normals[at] + bump)
            gloss[at], sharpness[at] = 0.055, 22.0
        elif kind == Material.KNIT:
            factor, bump = _knit(local[at])
            color[at] *= factor[:, None]
            normals[at] = unit_vectors(normals[at] + bump)
            gloss[at] = 0.008
        elif kind == Material.WOOD:
            color[at] *= _wood(local[at])
            gloss[at], sharpness[at] = 0.05, 30.0
        elif kind == Material.FLOOR:
            color[at] *= _speckled(local[at], 0.05, 0.35)[:, None]
        elif kind == Material.WALL:
            color[at] *= _speckled(local[at], 0.6, 0.06)[:, None]
        elif kind == Material.GLAZE:
            gloss[at], sharpness[at] = 0.32, 70.0
        elif kind == Material.PAPER:
            color[at] *= _speckled(local[at], 0.03, 0.05)[:, None]
    return Painted(color, normals, gloss, sharpness)


def _skin(rest: Array) -> tuple[Array, Array]:
    """Return blotches, and the fine relief of the skin, from places on the resting hand."""
    waves, phases, tints, relief = _skin_waves()
    angle = rest @ waves + phases
    factor = 1 + np.sin(angle) @ tints
    return np.clip(factor, 0.6, 1.4), np.cos(angle) * relief @ waves.T


@cache
def _skin_waves() -> tuple[Array, Array, Array, Array]:
    rng = np.random.default_rng(7)
    number = np.geomspace(60, 2600, 26)
    waves = (unit_vectors(rng.normal(size=(26, 3))) * number[:, None]).T
    tints = rng.normal(size=(26, 3)) * [0.5, 1.0, 1.0] * 0.022 + rng.normal(size=(26, 1)) * 0.010
    relief = np.where(number > 500, 0.055, 0.02) / number
    phases = rng.uniform(0, 2 * np.pi, 26)
    waves, phases, tints, relief = (x.astype(np.float32) for x in (waves, phases, tints, relief))
    return waves, phases, tints, relief


def _knit(local: Array) -> tuple[Array, Array]:
    """Return how bright a knitted fabric is, and the relief of its stitches; ribs where the third is 1."""
    u, v, rib = local.T
    wale, course = 2 * np.pi * u / 0.0042, 2 * np.pi * v / 0.0034
    zigzag = np.sin(course + 1.6 * np.abs(np.sin(wale / 2)) * 2)
    stitch = 0.80 + 0.16 * np.abs(np.sin(wale / 2)) + 0.10 * zigzag
    ribbed = 0.78 + 0.30 * np.cos(2 * np.pi * u / 0.009)
    cloudy = 1 + 0.10 * np.sin(61 * u + 3 * np.sin(47 * v)) * np.sin(53 * v)
    brightness = np.where(rib > 0.5, ribbed, stitch) * cloudy
    return brightness, 0.06 * np.stack([np.cos(wale), np.sin(wale), zigzag], -1)


def _wood(local: Array) -> Array:
    """Return the grain of an oak board, planks along the first axis."""
    texture = _wood_texture()
    place = (local[:, :2] / _WOOD_M * _TEXTURE).astype(np.float32)
    u = np.mod(place[:, 0] + 311.0 * np.floor(local[:, 1] / 0.143), 2 * _TEXTURE)
    u = np.where(u > _TEXTURE, 2 * _TEXTURE - u, u)
    return _look_up(texture, u, np.mod(place[:, 1], _TEXTURE - 1))


@cache
def _wood_texture() -> Float[Array, "h w 3"]:
    rng = np.random.default_rng(3)
    size = (_TEXTURE, _TEXTURE)
    bend = cv2.resize(rng.normal(size=(7, 4)).astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    rings = np.arange(_TEXTURE, dtype=np.float32)[:, None] / 13 + 3.2 * bend
    grain = 0.5 + 0.5 * np.sin(rings + 0.6 * np.sin(2.7 * rings))
    fibre = np.zeros(size, np.float32)
    for rows, columns, strength in ((1024, 24, 0.5), (512, 10, 0.5), (256, 60, 0.3)):
        noise = rng.normal(size=(rows, columns)).astype(np.float32)
        fibre += strength * cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC)
    value = 1.0 + 0.13 * (grain - 0.5) + 0.085 * fibre
    plank = np.repeat(rng.normal(1, 0.05, 8), _TEXTURE // 8)[:, None]
    return (value * plank)[..., None] ** np.array([1.0, 1.25, 1.5], np.float32)


def _speckled(local: Array, size: float, strength: float) -> Array:
    """Return noise about 1 from two coordinates, whichever vary."""
    texture = _cloud_texture()
    place = (local / size * 48).astype(np.float32)
    u, v = np.mod(place[:, 0] + 0.37 * place[:, 2], 2 * _TEXTURE), np.mod(place[:, 1], 2 * _TEXTURE)
    u, v = (np.where(x > _TEXTURE, 2 * _TEXTURE - x, x) for x in (u, v))
    return 1 + strength * _look_up(texture, u, v)


@cache
def _cloud_texture() -> Float[Array, "h w"]:
    rng = np.random.default_rng(5)
    total = np.zeros((_TEXTURE, _TEXTURE), np.float32)
    for octave in range(4):
        cells = 2 ** (octave + 4)
        noise = rng.normal(size=(cells, cells)).astype(np.float32)
        total += 0.6**octave * cv2.resize(noise, total.shape, interpolation=cv2.INTER_CUBIC)
    return total / total.std() / 2


def _look_up(texture: Array, u: Array, v: Array) -> Array:
    """Sample a texture at many places; OpenCV wants them as an image of limited width."""
    width = 4096
    count = -(-len(u) // width) * width
    columns, rows = (np.resize(x.astype(np.float32), count).reshape(-1, width) for x in (u, v))
    out = cv2.remap(texture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return out.reshape(count, *texture.shape[2:])[: len(u)]
