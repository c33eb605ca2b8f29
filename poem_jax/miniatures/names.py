"""The miniatures by name: six data sets as their authors give them out, and the archives packed from them."""

from collections.abc import Callable
from functools import partial
from typing import Final

from poem_jax.miniatures import arctic, dexycb, freihand, ho3d, interhand, oakink, released_tars
from poem_jax.miniatures.scene import PlantedFrame

WRITERS: Final[dict[str, Callable[..., list[PlantedFrame]]]] = {
    "dexycb": dexycb.write,
    "ho3d-v2": partial(ho3d.write, version="v2"),
    "ho3d-v3": partial(ho3d.write, version="v3"),
    "oakink": oakink.write,
    "arctic": arctic.write,
    "interhand": interhand.write,
    "freihand": freihand.write,
    **{f"tars-{name}": partial(released_tars.write, name) for name in released_tars.KINDS},
}
"""Each writes below the folder that it is given, and returns what a reader must find there."""
