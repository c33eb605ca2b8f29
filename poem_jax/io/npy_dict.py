"""Read a dict of arrays from a `.npy` file, as `np.save(path, {...})` writes it, without trusting its pickle.

Such a file is a header that announces an array of Python objects without axes, and behind it the pickle of
that array. NumPy reads it with `allow_pickle=True` only, which runs whatever the pickle says. Here the pickle
goes through the reader of `safe_pickle`, which knows one thing more: an array without axes may hold one dict.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.io import safe_pickle
from poem_jax.io.pickled_arrays import ObjectDtype, PickledArray, refuse_change

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
    with safe_pickle._problems_named(str(path)):
        described = _Reader(stream, safe_pickle.Vocabulary(), str(path)).load()
        held = safe_pickle._Finisher().finish(described)
    if not isinstance(held, list) or not isinstance(held[0], dict):
        raise ValueError(f"{path} must hold one dict; got a {type(held).__name__}")
    return held[0]


class _Reader(safe_pickle._Reader):
    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name)
        return safe_pickle.Inert(name, _announce) if name == "_reconstruct" else found


def _announce(subtype: Any, shape: Any, dtype: Any) -> PickledArray:
    safe_pickle._reconstruct(subtype, shape, dtype)
    return _ArrayOrDict()


class _ArrayOrDict(PickledArray):
    """An array of numbers or, without axes, one dict, which `array` gives as [dict]."""

    def __setstate__(self, state: Any) -> None:
        if not _is_of_one_dict(state):
            super().__setstate__(state)
            return
        if self._raw is not None or self._rows is not None:
            refuse_change("a finished array")
        self._rows = state[-1]


def _is_of_one_dict(state: Any) -> bool:
    whole = isinstance(state, tuple) and len(state) == 5 and isinstance(state[2], ObjectDtype)
    if not whole or state[1] != () or not isinstance(state[4], list):
        return False
    return len(state[4]) == 1 and isinstance(state[4][0], dict)
