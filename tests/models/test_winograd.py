"""Minimal filtering against the plain sum over windows, and where inference uses it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models import layers, winograd
from poem_jax.models.layers import Conv


def plain(x, kernel):
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), ((1, 1), (1, 1)), dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def drawn(shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


@pytest.mark.parametrize("hw", [(8, 6), (7, 9), (1, 2), (3, 1)])
def test_it_is_the_convolution_whatever_the_size(hw):
    with jax.enable_x64(True):
        x, kernel = drawn((2, *hw, 5)), drawn((3, 3, 5, 4), 1)
        np.testing.assert_allclose(
            winograd.convolve(x, winograd.transformed(kernel)), plain(x, kernel), atol=1e-12
        )


def test_its_gradients_are_those_of_the_convolution():
    with jax.enable_x64(True):
        x, kernel, weights = drawn((2, 7, 6, 5)), drawn((3, 3, 5, 4), 1), drawn((2, 7, 6, 4), 2)

        def by_filtering(x, kernel):
            return jnp.sum(weights * winograd.convolve(x, winograd.transformed(kernel)) ** 2)

        def by_convolution(x, kernel):
            return jnp.sum(weights * plain(x, kernel) ** 2)

        got = jax.grad(by_filtering, (0, 1))(x, kernel)
        expected = jax.grad(by_convolution, (0, 1))(x, kernel)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10), got, expected)


def test_kernels_of_a_row_of_blocks_are_transformed_one_by_one():
    kernels = drawn((3, 3, 3, 2, 4)).astype(jnp.float32)
    each = [winograd.transformed(kernel) for kernel in kernels]
    np.testing.assert_allclose(winograd.transformed(kernels), np.stack(each), rtol=1e-6)


@pytest.mark.parametrize(
    ("c_in", "c_out", "size", "stride", "pixels", "changes"),
    [
        (64, 96, 3, 1, 512, True),
        (160, 160, 3, 1, 256, True),
        (64, 64, 3, 2, 512, False),
        (64, 64, 1, 1, 512, False),
        (24, 64, 3, 1, 4096, False),
        (512, 64, 3, 1, 512, False),
        (64, 96, 3, 1, 256, False),
    ],
)
def test_wide_convolutions_of_large_maps_are_prepared(c_in, c_out, size, stride, pixels, changes):
    conv = Conv(c_in, c_out, size, stride, bias=True, rngs=nnx.Rngs(0))
    x = drawn((1, 10, 6, c_in)).astype(jnp.float32)
    before, shape = conv(x), conv.kernel[...].shape
    conv.prepare_for_cpu(pixels)
    assert (conv.kernel[...].shape != shape) == changes
    np.testing.assert_allclose(conv(x), before, atol=2e-5)


@pytest.mark.parametrize("hw", [(8, 6), (7, 9), (1, 2), (3, 1)])
def test_the_gradient_of_the_kernel_is_that_of_the_convolution(hw):
    with jax.enable_x64(True):
        x, slope = drawn((2, *hw, 5)), drawn((2, *hw, 4), 1)
        _, pull = jax.vjp(lambda kernel: plain(x, kernel), drawn((3, 3, 5, 4), 2))
        np.testing.assert_allclose(winograd.kernel_gradient(x, slope), pull(slope)[0], atol=1e-12)


@pytest.mark.parametrize(
    ("c_in", "c_out", "size", "stride", "hw", "has_own"),
    [
        (32, 48, 3, 1, (16, 12), True),
        (32, 48, 3, 2, (16, 12), False),
        (32, 48, 1, 1, (16, 12), False),
        (16, 48, 3, 1, (16, 12), False),
        (32, 192, 3, 1, (16, 12), False),
    ],
)
def test_training_has_the_gradients_of_inference(c_in, c_out, size, stride, hw, has_own):
    conv = Conv(c_in, c_out, size, stride, bias=True, rngs=nnx.Rngs(0))
    graph, state = nnx.split(conv)

    def loss(state, x, training):
        return jnp.sum(nnx.merge(graph, state)(x, training=training) ** 3)

    with jax.enable_x64(True):
        x = drawn((3, *hw, c_in))
        state = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), state)
        plain_ones, own = (jax.grad(loss, (0, 1))(state, x, training) for training in (False, True))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), own, plain_ones)
        text = str(jax.make_jaxpr(jax.grad(loss), static_argnums=2)(state, x, True))
    assert ("optimization_barrier" in text) == has_own


@pytest.mark.parametrize(("platform", "is_filtered"), [("cpu", True), ("cuda", False)])
def test_accelerators_keep_the_gradients_of_their_compiler(platform, is_filtered):
    conv = Conv(32, 48, 3, rngs=nnx.Rngs(0))
    graph, state = nnx.split(conv)

    def loss(state, x):
        return jnp.sum(nnx.merge(graph, state)(x, training=True) ** 3)

    x = jnp.ones((3, 16, 12, 32))
    text = jax.jit(jax.grad(loss)).trace(state, x).lower(lowering_platforms=(platform,)).as_text()
    assert ("optimization_barrier" in text) == is_filtered


def test_the_gradients_of_an_accelerator_are_the_same():
    x, slope = drawn((2, 6, 5, 3)).astype(jnp.float32), drawn((2, 6, 5, 4), 1).astype(jnp.float32)
    np.testing.assert_allclose(
        layers._plain_kernel_gradient(x, slope), winograd.kernel_gradient(x, slope), atol=1e-4
    )


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_sums_over_many_tiles_keep_their_digits(dtype):
    """Rounding the inputs is all that half numbers lose: the sums are of float32."""
    x, slope = (drawn((8, 32, 32, 32), seed).astype(dtype) for seed in range(2))
    with jax.enable_x64(True):
        exact = np.asarray(winograd.kernel_gradient(x.astype(jnp.float64), slope.astype(jnp.float64)))
    error = np.abs(np.asarray(winograd.kernel_gradient(x, slope), np.float64) - exact).max()
    assert error / np.abs(exact).max() < (2e-6 if dtype == jnp.float32 else 2e-2)
