"""Skin per vertex: tone, smooth blotches, redder finger tips and knuckles, darker creases, nails.

What depends on the hand alone (which vertices are nails, how near the tips they lie) is found once from the
resting template's joints, so that it also fits a user's MANO file. Colours are linear RGB.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.hand.model import HandModel, hand_mesh
from poem_jax.hand.topology import (
    FINGER_JOINTS,
    INDEX_KNUCKLE,
    LITTLE_KNUCKLE,
    NUM_FINGERS,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    ROOT_JOINT,
    WRIST,
)
from poem_jax.typing import Array, Float

_TONES_SRGB = np.array(
    [[255, 222, 198], [236, 188, 155], [208, 152, 115], [160, 105, 72], [104, 66, 46], [62, 40, 32]]
)
_TONES = (_TONES_SRGB / 255.0) ** 2.2
_RED = np.array([1.08, 0.80, 0.78])
_NAIL = np.array([1.12, 1.06, 1.08])
_WAVES = 8


class SkinMap(NamedTuple):
    """Where on the resting hand things are, in [0, 1] per vertex."""

    rest: Float[Array, "vert 3"]
    nail: Float[Array, " vert"]
    crease: Float[Array, " vert"]
    red: Float[Array, " vert"]
    palm: Float[Array, " vert"]


def map_skin(hand: HandModel, normals: Float[Array, "vert 3"]) -> SkinMap:
    """Find nails, creases, tips and the palm's side of a hand; `normals` are those of its template."""
    rest = np.asarray(hand.v_template, np.float64)
    zeros = np.zeros((NUM_SKELETON_JOINTS, 3), np.float32), np.zeros(NUM_SHAPES, np.float32)
    joints = np.asarray(hand_mesh(hand, *zeros).joints, np.float64)
    dorsal, radial = _palm_axes(joints, bool(hand.is_left))
    nail, crease, red = np.zeros(len(rest)), np.zeros(len(rest)), np.zeros(len(rest))
    for finger in range(NUM_FINGERS):
        chain = joints[list(FINGER_JOINTS[finger])]
        # A thumb nail faces half-way between the back of the hand and its radial side.
        up = dorsal + 0.9 * radial if finger == 0 else dorsal
        nail = np.maximum(nail, _nail(rest, normals, chain[2], chain[3], up))
        red = np.maximum(red, np.exp(-np.sum((rest - chain[3]) ** 2, -1) / 0.012**2))
        for joint in chain[:3]:
            distance = np.sum((rest - joint) ** 2, -1)
            crease = np.maximum(crease, np.exp(-distance / 0.009**2))
            red = np.maximum(red, 0.5 * np.exp(-distance / 0.011**2) * (normals @ dorsal > 0.3))
    return SkinMap(rest, nail, crease, red, np.clip(-(normals @ dorsal), 0, 1))


def skin_colors(
    skin: SkinMap, rest: Float[Array, "vert 3"], rng: np.random.Generator
) -> Float[Array, "vert 3"]:
    """Draw one person's skin for the hand's vertices and any further ones behind them.

    Args:
        skin: of the hand.
        rest: resting places of hand and forearm vertices, where the blotches are read; the hand's come first.
        rng: source of all chance.
    """
    tone = _tone(rng)
    waves = rng.normal(size=(3, _WAVES)) * rng.uniform(20, 180, _WAVES)
    strength = rng.uniform(0.01, 0.07) * rng.normal(size=(_WAVES, 3)) * [0.7, 1.0, 1.0]
    factor = 1 + np.sin(rest @ waves + rng.uniform(0, 2 * np.pi, _WAVES)) @ strength
    factor *= rng.normal(1, rng.uniform(0.0, 0.05), (len(rest), 1))
    amounts = rng.uniform([0.2, 0.1, 0.0, 0.3], [1.0, 0.45, 0.3, 1.0])
    n = len(skin.rest)
    factor[:n] *= 1 + amounts[0] * skin.red[:, None] * (_RED - 1)
    factor[:n] *= 1 - amounts[1] * (skin.crease * (1 - skin.nail))[:, None]
    factor[:n] *= 1 + amounts[2] * skin.palm[:, None]
    colors = np.clip(tone * factor, 0.01, 0.95)
    nail = _nail_color(rng, tone)
    colors[:n] += (amounts[3] * skin.nail)[:, None] * (nail - colors[:n])
    return colors


def _tone(rng: np.random.Generator) -> Float[Array, "3"]:
    place = rng.uniform(0, len(_TONES) - 1)
    low = int(place)
    tone = _TONES[low] + (place - low) * (_TONES[low + 1] - _TONES[low])
    return np.clip(tone * rng.normal(1, 0.06, 3) * rng.normal(1, 0.08), 0.01, 0.95)


def _nail_color(rng: np.random.Generator, tone: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return a bare nail's colour, or now and then a varnish."""
    varnish = rng.uniform(0, 1, 4)
    return varnish[:3] ** 2 if varnish[3] < 0.12 else np.clip(tone * _NAIL + 0.06, 0, 0.95)


def _palm_axes(joints: Float[Array, "21 3"], is_left: bool) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return unit vectors to the back of the hand and to the thumb's side of the palm."""
    index, middle, little = joints[INDEX_KNUCKLE], joints[ROOT_JOINT], joints[LITTLE_KNUCKLE]
    radial = index - little
    radial /= np.linalg.norm(radial)
    # A right hand with its palm down and fingers pointing away has the thumb on its left.
    dorsal = np.cross(middle - joints[WRIST], radial) * (-1 if is_left else 1)
    return dorsal / np.linalg.norm(dorsal), radial


def _nail(
    rest: Float[Array, "vert 3"],
    normals: Float[Array, "vert 3"],
    distal: Float[Array, "3"],
    tip: Float[Array, "3"],
    up: Float[Array, "3"],
) -> Float[Array, " vert"]:
    along = tip - distal
    length = np.linalg.norm(along)
    along = along / length
    up = up - (up @ along) * along
    up = up / np.linalg.norm(up)
    place = (rest - distal) @ along / length
    aside = np.abs((rest - distal) @ np.cross(along, up))
    inside = (place > 0.45) & (place < 1.05) & (aside < 0.008) & (normals @ up > 0.55)
    return inside.astype(np.float64)
