"""The hand that ships: our own, since MANO's licence forbids shipping MANO. Made by `tools/make_hand.py`.

The frame is MANO's: metres, a right hand, flat in the X-Z plane. The fingers point along -x and the thumb
towards +z, the palm faces -y, so that a positive turn about z bends a finger into the palm.
"""

from functools import cache
from importlib.resources import files

import numpy as np

from poem_jax.hand.model import HandModel, mirror

TEMPLATE_FILE = "template.npz"
SHAPE_NAMES = (
    "size",
    "girth",
    "slenderness",
    "finger_proportion",
    "palm_thickness",
    "thumb_length",
    "thumb_girth",
    "finger_taper",
    "radial_fingers",
    "end_segments",
)
"""What each shape coefficient of the shipped hand changes; +1 = one standard deviation more."""


def default_hand(side: str = "right") -> HandModel:
    """Return the shipped hand as float32 NumPy arrays (cached and read-only).

    Raises:
        ValueError: `side` is neither "right" nor "left".
    """
    if side not in ("right", "left"):
        raise ValueError(f'`side` must be "right" or "left"; got {side!r}')
    return _hand(side)


@cache
def _hand(side: str) -> HandModel:
    model = _shipped() if side == "right" else mirror(_hand("right"))
    model = HandModel(*(np.array(array, order="C") for array in model))
    for array in model:
        array.setflags(write=False)
    return model


def _shipped() -> HandModel:
    with files("poem_jax.hand").joinpath(TEMPLATE_FILE).open("rb") as stream, np.load(stream) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return HandModel(**{**arrays, "faces": arrays["faces"].astype(np.int32), "is_left": np.array(False)})
