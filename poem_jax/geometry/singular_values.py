"""Singular values of many small matrices in JAX, without the lock of jaxlib 0.10 on a CPU.

There LAPACK's batched calls split their work over the thread pool of XLA's operations, and wait for it on a
thread of that same pool: when as many calls run at once as the pool has threads, as of two devices on two
cores, none ever ends. (jaxlib 0.11.2 no longer splits: when no older one is supported, this file can go.) So
a CPU takes the matrices one by one here, at about 25 to 40 microseconds each for 16 x 4.

The fits' factorisations (`fitting/lm.py`, `smooth.py`) are batched calls still: a fit runs on one device, and
makes one of them at a time.
"""

import math

import jax
import jax.numpy as jnp

from poem_jax.typing import Array, Float


@jax.custom_batching.custom_vmap
def svd(
    A: Float[Array, "*batch m n"],
) -> tuple[Float[Array, "*batch m k"], Float[Array, "*batch k"], Float[Array, "*batch k n"]]:
    """Return U, the singular values, largest first, and V^T, with k = min(m, n); not differentiable."""
    return jax.lax.platform_dependent(A, cpu=_one_by_one, default=_at_once)


@svd.def_vmap
def _svd_of_a_batch(axis_size: int, in_batched: list[bool], A: Array) -> tuple[tuple, tuple]:
    """Another axis in front is another axis of the batch."""
    return svd(A), (True, True, True)


def _at_once(A: Array) -> tuple[Array, Array, Array]:
    U, S, Vt = jnp.linalg.svd(A, full_matrices=False)
    return U, S, Vt


def _one_by_one(A: Array) -> tuple[Array, Array, Array]:
    batch, size = A.shape[:-2], math.prod(A.shape[:-2])
    if size == 1:
        return _at_once(A)
    parts = jax.lax.map(_at_once, A.reshape(size, *A.shape[-2:]))
    U, S, Vt = (part.reshape(*batch, *part.shape[1:]) for part in parts)
    return U, S, Vt
