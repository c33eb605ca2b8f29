"""Where the rig of a capture lies: a file that the user names, or one in the capture's folder."""

import os
from pathlib import Path

from poem_jax.calibration.rig_json import read_rig
from poem_jax.geometry.rig import Rig

RIG_FILES = ("rig.json", "calibration/rig.json")


def find_rig(folder: str | os.PathLike, rig: str | os.PathLike | None = None) -> Rig:
    """Read the rig of a capture: the given file, else `rig.json` or `calibration/rig.json` in the folder.

    Raises: FileNotFoundError, ValueError: as `read_rig`.
    """
    if rig is not None:
        return read_rig(rig)
    places = [Path(folder) / name for name in RIG_FILES]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        looked = " or ".join(map(str, places))
        raise FileNotFoundError(f"no {looked}: no rig: pass --rig FILE, or put it there")
    return read_rig(found)
