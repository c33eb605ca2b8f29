import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models.layers import Conv, convolve
from tests.precision import convolve_by_products


@pytest.mark.parametrize("size", [1, 3, 7])
@pytest.mark.parametrize("stride", [1, 2])
def test_convolution_is_a_sum_over_windows(size, stride):
    conv = Conv(2, 3, size, stride, bias=True, rngs=nnx.Rngs(0))
    x = np.random.default_rng(0).normal(size=(1, 8, 6, 2)).astype(np.float32)
    pad = (size - 1) // 2
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    kernel = np.asarray(conv.kernel[...])
    expected = np.zeros((1, 8 // stride, 6 // stride, 3))
    for i in range(8 // stride):
        for j in range(6 // stride):
            window = padded[0, i * stride : i * stride + size, j * stride : j * stride + size]
            expected[0, i, j] = np.einsum("hwc,hwcd->d", window, kernel)
    np.testing.assert_allclose(conv(jnp.asarray(x)), expected, atol=1e-5)


@pytest.mark.parametrize("size", [1, 3, 7])
@pytest.mark.parametrize("stride", [1, 2])
def test_it_and_its_gradients_are_those_of_products(size, stride):
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        x, kernel = rng.normal(size=(2, 8, 6, 2)), rng.normal(size=(size, size, 2, 3))
        whole, products = (
            jax.vjp(functools.partial(form, stride=stride), x, kernel)
            for form in (convolve, convolve_by_products)
        )
        np.testing.assert_allclose(products[0], whole[0], atol=1e-12)
        gradient = rng.normal(size=whole[0].shape)
        for ours, theirs in zip(products[1](gradient), whole[1](gradient), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_first_weights_keep_the_variance():
    conv = Conv(64, 64, 3, rngs=nnx.Rngs(0))
    x = jax.random.normal(jax.random.key(1), (4, 16, 16, 64))
    assert 1.6 < float(jnp.var(conv(x)[:, 2:-2, 2:-2])) < 2.4
