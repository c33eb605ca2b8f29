"""Singular values of many matrices, whatever else runs at the same time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.singular_values import svd


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


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="of the CPU's LAPACK alone")
def test_no_call_of_lapack_has_more_than_one_matrix_which_could_lock_the_threads():
    program = jax.jit(svd).lower(jnp.ones((7, 5, 4))).compile().as_text() or ""
    calls = [line for line in program.splitlines() if "lapack" in line and "custom-call(" in line]
    assert calls
    assert not any("f32[7," in line for line in calls)
