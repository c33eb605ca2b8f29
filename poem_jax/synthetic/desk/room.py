"""What does not move: the desk with a mug, a notebook and a pencil, the floor, the walls."""

import numpy as np

from poem_jax.synthetic.desk.surface import Material, Surface, box, join, sheet, tube

_WOOD = (0.47, 0.30, 0.165)
_WALL = (0.66, 0.635, 0.585)
_FLOOR = (0.20, 0.185, 0.17)
_PLASTER_STEP_M = 0.12


def room_surface() -> Surface:
    """Return desk, things on it, floor and walls."""
    return join([*_desk(), *_mug(), *_notebook(), *_shell()])


def _desk() -> list[Surface]:
    left, near, width, depth, thick = -0.80, -0.27, 1.60, 0.86, 0.035
    top = sheet((left, near, 0), (width, 0, 0), (0, depth, 0), 0.0125, Material.WOOD, _WOOD)
    middle = (left + width / 2, near + depth / 2, -thick / 2 - 0.0005)
    return [top, box(middle, (width / 2, depth / 2, thick / 2), 0.0, Material.WOOD, _WOOD, step=0.06)]


def _mug() -> list[Surface]:
    """Return a mug with its handle and the coffee in it."""
    center, height, radius = np.array([-0.33, 0.20, 0.0]), 0.092, 0.041
    profile = [
        (0.86, 0.0),
        (0.97, 0.012),
        (1.0, 0.1),
        (1.0, 0.9),
        (1.0, 0.985),
        (0.97, 1.0),
        (0.93, 0.985),
        (0.92, 0.78),
    ]
    angle = 2 * np.pi * np.arange(40) / 40
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rings = np.stack([radius * r * circle + [0, 0, height * h] for r, h in profile]) + center
    white = (0.74, 0.72, 0.68)
    coffee = np.stack([radius * r * circle + [0, 0, height * 0.8] for r in (0.925, 0.0)]) + center
    turn = np.linspace(-0.45 * np.pi, 0.45 * np.pi, 14)
    middle = np.stack([0.034 * np.cos(turn), 0 * turn, 0.031 * np.sin(turn)], -1)
    out = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], -1)
    around = 2 * np.pi * np.arange(12) / 12
    handle = middle[:, None] + 0.0052 * (
        np.cos(around)[None, :, None] * out[:, None] + np.sin(around)[None, :, None] * np.array([0.0, 1.5, 0])
    )
    c, s = np.cos(2.4), np.sin(2.4)
    handle = (handle + np.array([radius - 0.004, 0, height * 0.5])) @ np.array(
        [[c, s, 0], [-s, c, 0], [0, 0, 1]]
    ) + center
    return [
        tube(rings, Material.GLAZE, white, rings),
        tube(coffee, Material.GLAZE, (0.045, 0.02, 0.009), coffee),
        tube(handle[:, ::-1], Material.GLAZE, white, handle),
    ]


def _notebook() -> list[Surface]:
    """Return a notebook, a sheet of paper half under it, and a pencil on top."""
    paper = sheet(
        (0.20, 0.16, 0.0012), (0.20, 0.035, 0), (-0.05, 0.285, 0), 0.02, Material.PAPER, (0.80, 0.79, 0.75)
    )
    cover = box((0.36, 0.22, 0.009), (0.074, 0.105, 0.008), 14.0, Material.PAPER, (0.30, 0.035, 0.030))
    band = box((0.405, 0.231, 0.0095), (0.004, 0.1055, 0.0083), 14.0, Material.PAPER, (0.03, 0.03, 0.035))
    pencil = box((0.33, 0.215, 0.0215), (0.0036, 0.085, 0.0036), -28.0, Material.GLAZE, (0.78, 0.42, 0.03))
    return [paper, cover, band, pencil]


def _shell() -> list[Surface]:
    """Return floor, walls with a skirting, a picture, and the leg room's end."""
    low, high, half, back, front = -0.74, 1.9, 2.2, -1.5, 2.6
    step, walls = _PLASTER_STEP_M, []
    walls.append(
        sheet((-half, back, low), (2 * half, 0, 0), (0, front - back, 0), step, Material.FLOOR, _FLOOR)
    )
    for origin, along in (
        ((half, back, low), (-2 * half, 0, 0)),
        ((-half, front, low), (2 * half, 0, 0)),
        ((-half, back, low), (0, front - back, 0)),
        ((half, front, low), (0, back - front, 0)),
    ):
        walls.append(sheet(origin, along, (0, 0, high - low), step, Material.WALL, _WALL))
    white = (0.70, 0.69, 0.66)
    skirting = box((0, back + 0.012, low + 0.05), (half, 0.011, 0.05), 0.0, Material.GLAZE, white)
    shelf = box((-0.95, back + 0.16, -0.2), (0.35, 0.15, 0.54), 0.0, Material.WOOD, (0.50, 0.47, 0.42))
    cushion = box((0.95, back + 0.3, -0.45), (0.3, 0.26, 0.28), 8.0, Material.KNIT, (0.15, 0.165, 0.15))
    return [*walls, skirting, shelf, cushion]
