"""Take arrays out of the variables that MANO's pickles hold: chumpy's and scipy's, as inert stand-ins.

The state of a stand-in is whatever the file says. It is checked before NumPy allocates or follows anything,
so that a damaged or hostile file ends in a `ValueError`.
"""

import math
from typing import Any

import numpy as np

from poem_jax.hand.topology import NUM_VERTICES
from poem_jax.io.safe_pickle import StandIn

_DEEPEST_SELECTION = 8
_MOST_DIMENSIONS = 8


def as_array(value: Any, depth: int = 0) -> np.ndarray | None:
    """Take the array out of an array, a chumpy variable or a sparse matrix; None if there is none.

    Raises:
        ValueError: the parts of a stand-in do not fit together; the message says which.
    """
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, StandIn):
        return None
    if depth > _DEEPEST_SELECTION:
        raise ValueError(f"chumpy variables select from each other more than {_DEEPEST_SELECTION} deep")
    return _dense(value) if value.module.startswith("scipy.sparse") else _chumpy_value(value, depth)


def _chumpy_value(value: StandIn, depth: int) -> np.ndarray | None:
    """A constant holds `x`; a selection of another variable holds it as `a`, with flat `idxs` and a shape."""
    state = value.state
    if isinstance(state.get("x"), np.ndarray):
        return state["x"]
    inner = as_array(state.get("a"), depth + 1)
    if inner is None:
        return None
    if state.get("idxs") is None:
        return inner
    indices = _integers(state["idxs"], "idxs", below=inner.size)
    picked = inner.ravel()[indices]
    shape = state.get("preferred_shape")
    return picked if shape is None else picked.reshape(_checked_shape(shape, "preferred_shape", picked.size))


def _dense(value: StandIn) -> np.ndarray | None:
    """Spell out a compressed sparse matrix (csc: columns, csr: rows)."""
    state = value.state
    stored_shape, data = state.get("_shape", state.get("shape")), state.get("data")
    if stored_shape is None or not isinstance(data, np.ndarray) or data.dtype.kind not in "fiu":
        return None
    rows, columns = shape = _checked_pair(stored_shape)
    by_column = value.name.startswith("csc")
    num_major, num_minor = (columns, rows) if by_column else (rows, columns)
    indices = _integers(state.get("indices"), "indices", below=num_minor)
    starts = _integers(state.get("indptr"), "indptr", below=len(indices) + 1)
    counts = np.diff(starts)
    if data.shape != indices.shape or len(starts) != num_major + 1 or (counts < 0).any():
        raise ValueError(f"data, indices and indptr do not make a sparse matrix of shape {shape}")
    if starts[0] != 0 or starts[-1] != len(indices):
        raise ValueError(f"indptr must run from 0 to {len(indices)}; got {starts[0]} to {starts[-1]}")
    major = np.repeat(np.arange(num_major), counts)
    dense = np.zeros((rows, columns), dtype=float)
    np.add.at(dense, (indices, major) if by_column else (major, indices), data)
    return dense


def _checked_pair(shape: Any) -> tuple[int, int]:
    sizes = _integers(shape, "shape", below=NUM_VERTICES + 1).tolist()
    if len(sizes) != 2:
        raise ValueError(f"a sparse matrix must have 2 dimensions; got {len(sizes)}")
    return sizes[0], sizes[1]


def _checked_shape(shape: Any, name: str, size: int) -> tuple[int, ...]:
    sizes = tuple(_integers(shape, name, below=size + 1).tolist())
    if len(sizes) > _MOST_DIMENSIONS or math.prod(sizes) != size:
        raise ValueError(f"{name} must arrange {size} values; got {sizes[:_MOST_DIMENSIONS]}")
    return sizes


def _integers(value: Any, name: str, below: int) -> np.ndarray:
    """Return a flat array (n,) of integers in [0, below)."""
    if isinstance(value, list | tuple) and all(type(n) is int and abs(n) < 2**62 for n in value):
        value = np.array(value, dtype=np.int64)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iu" or value.ndim != 1:
        raise ValueError(f"{name} must be a flat list of whole numbers; got a {type(value).__name__}")
    if value.size and (value.min() < 0 or value.max() >= below):
        raise ValueError(
            f"{name} must hold numbers from 0 to {below - 1}; got {value.min()} to {value.max()}"
        )
    return value.astype(np.int64)
