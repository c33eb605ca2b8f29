"""Comparisons in float64, quicker convolutions for them, and what a traced program multiplies in."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.typing import Array


def products(jaxpr: Any) -> Iterator[Any]:
    """Yield the matrix products of a program, those of its loops and functions included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns")):
            if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                yield from products(getattr(inner, "jaxpr", inner))


def coarse_products(function: Callable, *args: Any) -> list[str]:
    """Return the float products that an accelerator would compute in fewer bits than float32 has."""
    found = list(products(jax.make_jaxpr(function)(*args).jaxpr))
    assert found, "a test of products must see some"
    full = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    floats = (e for e in found if jnp.issubdtype(e.outvars[0].aval.dtype, jnp.floating))
    return [str(e.source_info.traceback) for e in floats if e.params["precision"] != full]


def as_float64(tree: Any) -> Any:
    """Return the tree with its floating leaves in float64; needs `jax.enable_x64(True)`."""
    return jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float64 if jnp.issubdtype(x.dtype, jnp.floating) else None), tree
    )


def convolve_by_products(x: Array, kernel: Array, stride: int = 1) -> Array:
    """Return what `layers.convolve` does, by matrix products.

    XLA:CPU computes the gradients of products in float64 several times as fast as those of convolutions.
    """
    pad = (len(kernel) - 1) // 2

    @jax.checkpoint
    def sum_over_windows(x: Array, kernel: Array) -> Array:
        """The windows, many times as large as the image, are not kept for the gradient."""
        size, (h, w) = len(kernel), x.shape[1:3]
        x = jnp.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
        windows = [x[:, i : i + h : stride, j : j + w : stride] for i, j in np.ndindex(size, size)]
        return jnp.concatenate(windows, -1) @ kernel.reshape(-1, kernel.shape[-1])

    return sum_over_windows(x, kernel)
