"""The unit of lengths in calibration files: said by the file or the user, else the custom of the format."""

import logging
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from poem_jax.geometry.camera_checks import MAX_CAMERA_DISTANCE
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.typing import Array, Float

METRES_PER_UNIT = {"metre": 1.0, "centimetre": 1e-2, "millimetre": 1e-3, "inch": 0.0254}
_SYMBOLS = {"metre": "m", "centimetre": "cm", "millimetre": "mm", "inch": "in"}
_UNIT_NAMES = {
    name: unit
    for unit, symbol in _SYMBOLS.items()
    for name in (symbol, unit, f"{unit}s", unit.replace("metre", "meter"), unit.replace("metre", "meters"))
} | {"inches": "inch"}
EXTENT_M = (0.03, MAX_CAMERA_DISTANCE)
"""Between the farthest two cameras of a rig: beyond these limits its unit is doubted."""

_log = logging.getLogger(__name__)


def metres_of(unit: str | float) -> float:
    """Return the metres of a unit: `metre`, `cm`, `millimeters`, or a number, the metres of one unit.

    Raises: ValueError: no such unit, or a number that is not positive and finite.
    """
    name = _UNIT_NAMES.get(str(unit).strip().lower())
    if name is not None:
        return METRES_PER_UNIT[name]
    try:
        metres = float(unit)
    except (TypeError, ValueError):
        metres = np.nan
    if not 0 < metres < np.inf:
        known = ", ".join(METRES_PER_UNIT)
        raise ValueError(f"the unit must be one of {known}, or a number, its metres; got {str(unit)[:40]!r}")
    return metres


def known_unit(name: object) -> str | None:
    """Return the unit that a file names, in our spelling; None = it is none of ours."""
    return _UNIT_NAMES.get(str(name).strip().lower())


def customary_metres(
    T_cam_from_world: Float[Array, "view 4 4"], customs: Sequence[str], path: Path, kind: str
) -> float:
    """Return the metres of the unit that a format is customarily in, and log what was taken.

    Args:
        T_cam_from_world: In the unit of the file.
        customs: Units in which such files are written, the commonest first: the first under which the
            cameras stand as far apart as cameras do is taken.
        path: The file.
        kind: What it is read as.

    Raises: ValueError: under none of them they do.
    """
    farthest = farthest_pair(T_cam_from_world)
    apart = [METRES_PER_UNIT[unit] * farthest for unit in customs]
    believed = [
        unit
        for unit, distance in zip(customs, apart, strict=True)
        if farthest == 0 or EXTENT_M[0] <= distance <= EXTENT_M[1]
    ]
    if not believed:
        tried = " and ".join(f"{d:.3g} m if in {unit}s" for unit, d in zip(customs, apart, strict=True))
        raise ValueError(
            f"{path}: {kind} does not say its unit, and its cameras would stand {tried} apart: say it "
            "by `poem calibration convert IN rig.json --unit UNIT` (metre, centimetre, millimetre, inch, or "
            "the metres of one unit)"
        )
    unit = believed[0]
    _log.warning(
        "%s: %s does not say its unit; read as %ss, in which its cameras stand up to %.3g m apart. If that "
        "is wrong, `poem calibration convert` with --unit corrects it",
        path,
        kind,
        unit,
        METRES_PER_UNIT[unit] * farthest,
    )
    return METRES_PER_UNIT[unit]


def farthest_pair(T_cam_from_world: Float[Array, "view 4 4"]) -> float:
    """Return the distance of the two cameras farthest from each other, in the unit of the file."""
    centres = invert_rigid(T_cam_from_world)[:, :3, 3]
    pairs = combinations(centres, 2)
    return float(max((np.linalg.norm(a - b) for a, b in pairs), default=0.0))
