"""Array types and the vocabulary of dimension names.

Public signatures write `Float[Array, "*batch view 3 3"]`. `Array` accepts NumPy and JAX arrays alike, because
pure helpers follow the type they are given; the shape strings are checked by the test suite
(`--jaxtyping-packages`), never in production.

Dimension names: `batch`, `view`, `joint`, `vert`, `point`, `basis`, `query`, `layer`, `face`, `h`, `w`, `c`,
the literals `2`, `3`, `4`, and `*batch` for any number of leading axes.
"""

from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import jaxtyping
import numpy as np
from jaxtyping import Bool, Float, Int, Num, UInt8

if TYPE_CHECKING:
    from jaxtyping import PRNGKeyArray, PyTree

Array: TypeAlias = Any
"""A NumPy or JAX array; never a list."""

Params: TypeAlias = dict[str, Any]
"""`{"trainable": ..., "statistics": ..., "constants": ...}`, a plain pytree."""

__all__ = [
    "Array",
    "Bool",
    "Float",
    "Int",
    "Num",
    "PRNGKeyArray",
    "Params",
    "PyTree",
    "UInt8",
    "array_namespace",
]


def __getattr__(name: str) -> Any:
    # jaxtyping imports JAX for these two; data workers never ask for them.
    if name in ("PRNGKeyArray", "PyTree"):
        return getattr(jaxtyping, name)
    raise AttributeError(f"module 'poem_jax.typing' has no attribute '{name}'")


def array_namespace(*arrays: Array) -> ModuleType:
    """Return `jax.numpy` if any argument is a JAX array or tracer, else `numpy`.

    Helpers that the data workers share with the models compute in this namespace, so that NumPy goes in and
    out without importing JAX.
    """
    for array in arrays:
        if type(array).__module__.partition(".")[0] in ("jax", "jaxlib"):
            import jax.numpy as jnp

            return jnp
    return np
