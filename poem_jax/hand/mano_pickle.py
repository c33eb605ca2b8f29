"""Take arrays out of the variables that MANO's pickles hold: chumpy's and scipy's, as inert stand-ins.

The state of a stand-in is whatever the file says. It is checked before NumPy allocates or follows anything,
so that a damaged or hostile file ends in a `ValueError`.
"""

import math
from typing import Any

import numpy as np

from poem_jax.hand.topology import NUM_VERTICES
from poem_jax.io.safe_pickle import StandIn
from poem_jax.io.sparse_matrices import dense_matrix, is_sparse_matrix, whole_numbers

_DEEPEST_SELECTION = 8
_MAX_DIMENSIONS = 8


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
    if is_sparse_matrix(value.module, value.name):
        return dense_matrix(value, NUM_VERTICES)
    return _chumpy_value(value, depth)


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
    indices = whole_numbers(state["idxs"], "idxs", below=inner.size)
    picked = inner.ravel()[indices]
    shape = state.get("preferred_shape")
    return picked if shape is None else picked.reshape(_checked_shape(shape, "preferred_shape", picked.size))


def _checked_shape(shape: Any, name: str, size: int) -> tuple[int, ...]:
    sizes = tuple(whole_numbers(shape, name, below=size + 1).tolist())
    if len(sizes) > _MAX_DIMENSIONS or math.prod(sizes) != size:
        raise ValueError(f"{name} must arrange {size} values; got {sizes[:_MAX_DIMENSIONS]}")
    return sizes
