"""Spell out SciPy's sparse matrices from a pickle, where they are stand-ins that keep their state.

The state is whatever the file says. Every number of it is checked before NumPy allocates or follows anything,
so that a damaged or hostile file ends in a `ValueError`. Letters: a matrix is (row, column); each form gives
its entries as three flat arrays: rows, columns and values. Entries at one place add up, as in SciPy.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from poem_jax.io.safe_pickle import StandIn

_Entries = tuple[np.ndarray, np.ndarray, np.ndarray]


def is_sparse_matrix(module: str, name: str) -> bool:
    """Tell whether a global of a pickle is a class of SciPy's sparse matrices that is read here."""
    form, _, kind = name.partition("_")
    return module.startswith("scipy.sparse") and form in _FORMS and kind in ("matrix", "array")


def dense_matrix(value: StandIn, max_side: int) -> np.ndarray | None:
    """Return a sparse matrix (rows, columns) in full, float64; None if it holds no shape or no numbers.

    Raises:
        ValueError: A side is longer than `max_side`, or the parts of the matrix do not fit together; the
            message says which.
    """
    state, form = value.state, value.name.partition("_")[0]
    stored_shape, data = state.get("_shape", state.get("shape")), state.get("data")
    is_numbers = isinstance(data, np.ndarray) and data.dtype.kind in "fiu"
    if stored_shape is None or not (is_numbers or (form == "lil" and isinstance(data, list))):
        return None
    sides = whole_numbers(stored_shape, "shape", below=max_side + 1).tolist()
    if len(sides) != 2:
        raise ValueError(f"a sparse matrix must have 2 dimensions; got {len(sides)}")
    dense = np.zeros(sides)
    rows, columns, values = _FORMS[form](state, data, (sides[0], sides[1]))
    np.add.at(dense, (rows, columns), values)
    return dense


def whole_numbers(value: Any, name: str, below: int) -> np.ndarray:
    """Return a list or array of a pickle as a flat array (n,) of integers in [0, below).

    Raises:
        ValueError: It is something else; the message calls it `name`.
    """
    if isinstance(value, list | tuple) and all(type(n) is int and abs(n) < 2**62 for n in value):
        value = np.array(value, dtype=np.int64)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iu" or value.ndim != 1:
        raise ValueError(f"{name} must be a flat list of whole numbers; got a {type(value).__name__}")
    if value.size and (value.min() < 0 or value.max() >= below):
        raise ValueError(
            f"{name} must hold numbers from 0 to {below - 1}; got {value.min()} to {value.max()}"
        )
    return value.astype(np.int64)


def _by_row(state: dict[str, Any], data: Any, shape: tuple[int, int]) -> _Entries:
    """CSR: columns and values row after row; `indptr` tells where each row begins."""
    values = _values(data)
    return (*_compressed(state, len(values), *shape), values)


def _by_column(state: dict[str, Any], data: Any, shape: tuple[int, int]) -> _Entries:
    """CSC: the same by columns."""
    values = _values(data)
    columns, rows = _compressed(state, len(values), *shape[::-1])
    return rows, columns, values


def _compressed(
    state: dict[str, Any], count: int, num_major: int, num_minor: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the major and the minor place of each of `count` entries."""
    indices = whole_numbers(state.get("indices"), "indices", below=num_minor)
    starts = whole_numbers(state.get("indptr"), "indptr", below=len(indices) + 1)
    counts = np.diff(starts)
    if count != len(indices) or len(starts) != num_major + 1 or (counts < 0).any():
        raise ValueError(
            f"data, indices and indptr do not make a sparse matrix of {num_major} x {num_minor} entries"
        )
    if starts[0] != 0 or starts[-1] != len(indices):
        raise ValueError(f"indptr must run from 0 to {len(indices)}; got {starts[0]} to {starts[-1]}")
    return np.repeat(np.arange(num_major), counts), indices


def _by_block(state: dict[str, Any], data: Any, shape: tuple[int, int]) -> _Entries:
    """BSR: as CSR, with blocks (height, width) in the place of values."""
    if not isinstance(data, np.ndarray) or data.ndim != 3 or 0 in data.shape:
        raise ValueError("data must be blocks of numbers (block, height, width)")
    height, width = data.shape[1:]
    if shape[0] % height or shape[1] % width:
        raise ValueError(f"blocks of {height} x {width} do not fill a matrix of shape {shape}")
    rows, columns = _compressed(state, len(data), shape[0] // height, shape[1] // width)
    inner_rows, inner_columns = np.indices((height, width))
    rows = rows[:, None, None] * height + inner_rows
    columns = columns[:, None, None] * width + inner_columns
    return rows.ravel(), columns.ravel(), data.ravel()


def _by_coordinates(state: dict[str, Any], data: Any, shape: tuple[int, int]) -> _Entries:
    """COO: row, column and value of each entry; old versions of SciPy name them row and col."""
    coordinates = state.get("coords", (state.get("row"), state.get("col")))
    if not isinstance(coordinates, tuple) or len(coordinates) != 2:
        raise ValueError("coords must be a pair of rows and columns")
    names = ("rows", "columns")
    rows, columns = (
        whole_numbers(places, name, below=side)
        for places, name, side in zip(coordinates, names, shape, strict=True)
    )
    values = _values(data)
    if not len(rows) == len(columns) == len(values):
        raise ValueError(
            f"{len(values)} values must have as many rows and columns; got {len(rows)} and {len(columns)}"
        )
    return rows, columns, values


def _by_list(state: dict[str, Any], data: Any, shape: tuple[int, int]) -> _Entries:
    """LIL: for each row a list of columns and a list of values."""
    lists = state.get("rows")
    if not (isinstance(lists, list) and isinstance(data, list) and len(lists) == len(data) == shape[0]):
        raise ValueError(f"rows and data must be {shape[0]} lists each")
    counts = [len(row) if isinstance(row, list) else -1 for row in lists]
    same = all(isinstance(row, list) and len(row) == n for row, n in zip(data, counts, strict=True))
    # A list may stand in many places of a pickle: no row is followed that is longer than the matrix.
    if not same or max(counts, default=0) > shape[1]:
        raise ValueError(f"each row must be a list of at most {shape[1]} columns, and one of as many values")
    numbers = [[_plain(value) for row in part for value in row] for part in (lists, data)]
    columns = whole_numbers(numbers[0], "columns", below=shape[1])
    return np.repeat(np.arange(shape[0]), counts), columns, np.array(numbers[1], np.float64)


def _by_diagonal(state: dict[str, Any], data: Any, shape: tuple[int, int]) -> _Entries:
    """DIA: row k of `data` is the diagonal that begins `offsets[k]` columns to the right, by columns."""
    offsets = state.get("offsets")
    if not isinstance(offsets, np.ndarray) or not isinstance(data, np.ndarray) or data.ndim != 2:
        raise ValueError("data and offsets must be arrays: the rows of one and a flat list of offsets")
    if offsets.dtype.kind not in "iu" or offsets.shape != data.shape[:1]:
        raise ValueError("data must be a row of numbers for each of the flat list of offsets")
    data = data[:, : shape[1]]
    columns = np.broadcast_to(np.arange(data.shape[1]), data.shape)
    rows = columns - np.clip(offsets.astype(np.int64), -max(shape), max(shape))[:, None]
    inside = (rows >= 0) & (rows < shape[0])
    return rows[inside], columns[inside], data[inside]


def _plain(value: Any) -> int | float:
    value = value.item() if isinstance(value, np.number) else value
    if not isinstance(value, int | float) or (isinstance(value, int) and abs(value) >= 2**62):
        raise ValueError(f"columns and values must be numbers; got a {type(value).__name__}")
    return value


def _values(data: Any) -> np.ndarray:
    if not isinstance(data, np.ndarray) or data.ndim != 1:
        raise ValueError("data must be a flat array of numbers")
    return data


_FORMS: dict[str, Callable[[dict[str, Any], Any, tuple[int, int]], _Entries]] = {
    "csc": _by_column,
    "csr": _by_row,
    "bsr": _by_block,
    "coo": _by_coordinates,
    "lil": _by_list,
    "dia": _by_diagonal,
}
"""All forms but DOK, whose keys are tuples of NumPy's scalars; its users can save `matrix.tocsr()`."""
