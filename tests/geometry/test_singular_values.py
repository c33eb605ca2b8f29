"""Singular values of many matrices, whatever else runs at the same time."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.alignment import nearest_rotation
from poem_jax.geometry.singular_values import svd
from poem_jax.geometry.triangulation import null_vector


@pytest.mark.parametrize("shape", [(5, 4), (1, 5, 4), (2, 3, 5, 4), (6, 3, 3)])
def test_the_parts_make_the_matrix_again(shape):
    A = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    U, S, Vt = jax.jit(svd)(A)
    np.testing.assert_allclose((U * S[..., None, :]) @ Vt, A, atol=1e-5)
    np.testing.assert_allclose(S, np.linalg.svd(A, compute_uv=False), atol=1e-5)


def test_mapped_over_it_is_the_same():
    A = jnp.asarray(np.random.default_rng(1).normal(size=(3, 2, 5, 4)), jnp.float32)
    mapped = jax.vmap(svd, in_axes=1, out_axes=1)(A)
    jax.tree.map(np.testing.assert_array_equal, mapped, svd(A))


def solved(A):
    """What training differentiates: the null vectors of a batch of systems, mapped over another axis."""
    return jax.grad(lambda A: jnp.sum(jax.vmap(lambda a: null_vector(a)[0])(A) ** 3))(A)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="of the CPU's LAPACK alone")
@pytest.mark.parametrize(
    ("function", "shape"),
    [
        (svd, (7, 5, 4)),
        (jax.vmap(svd), (7, 3, 5, 4)),
        (jax.vmap(jax.vmap(svd)), (7, 3, 5, 4)),
        (solved, (7, 3, 5, 4)),
        (jax.vmap(nearest_rotation), (7, 3, 3)),
    ],
)
def test_no_call_of_lapack_has_more_than_one_matrix_which_could_lock_the_threads(function, shape):
    program = jax.jit(function).lower(jnp.ones(shape)).compile().as_text() or ""
    calls = [line for line in program.splitlines() if "lapack" in line and "custom-call(" in line]
    assert calls
    for line in calls:
        found = re.findall(r"f32\[([0-9,]+)\]", line)
        sizes = [[int(size) for size in dims.split(",")] for dims in found]
        assert sizes
        assert all(np.prod(size[:-2], initial=1) == 1 for size in sizes), line
