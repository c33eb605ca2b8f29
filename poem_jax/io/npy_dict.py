"""Read a dict of arrays from a `.npy` file, as `np.save(path, {...})` writes it, without trusting its pickle.

Such a file is a header that announces an array of Python objects without axes, and behind it the pickle of
that array. NumPy reads it with `allow_pickle=True` only, which runs whatever the pickle says. Here the pickle
goes through `safe_pickle`, which is asked to let an array without axes hold one dict.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.io.safe_pickle import loads_arrays_pickle

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def load_npy_dict(path: str | Path) -> dict[str, Any]:
    """Read a file that `np.save` wrote of a dict of arrays and plain containers.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no `.npy` of one dict, is cut short, or asks for more than arrays and plain
            containers.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}; give the path of a .npy that holds a dict")
    stream = io.BytesIO(path.read_bytes())
    try:
        header = _HEADERS[np.lib.format.read_magic(stream)]
        shape, _, dtype = header(stream)
    except (ValueError, KeyError) as error:
        raise ValueError(f"{path} is no .npy file, or cut short: {error}") from error
    if shape != () or not dtype.hasobject:
        raise ValueError(f"{path} must hold one dict; got an array of shape {shape} and dtype {dtype}")
    held = loads_arrays_pickle(stream.read(), source=str(path), array_of_dict=True)
    if not isinstance(held, list) or len(held) != 1 or not isinstance(held[0], dict):
        raise ValueError(f"{path} must hold one dict; got a {type(held).__name__}")
    return held[0]
