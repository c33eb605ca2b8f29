"""The layers against NumPy written out, in both of their forms."""

import numpy as np
import pytest

from poem_jax.detection import layers
from poem_jax.detection.layers import Convolution, Depthwise, Linear, convolve, depthwise, linear


def same_padded(x: np.ndarray, size: int, stride: int) -> np.ndarray:
    """TensorFlow's "SAME": ceil(n / stride) outputs, the odd row and column at the end."""
    around = []
    for length in x.shape[1:3]:
        missing = max((-(-length // stride) - 1) * stride + size - length, 0)
        around.append((missing // 2, missing - missing // 2))
    return np.pad(x, [(0, 0), *around, (0, 0)])


def written_out(x: np.ndarray, kernel: np.ndarray, stride: int) -> np.ndarray:
    size = kernel.shape[0]
    padded = same_padded(x, size, stride)
    out = [-(-length // stride) for length in x.shape[1:3]]
    y = np.zeros((len(x), *out, kernel.shape[-1]))
    for i, j in np.ndindex(*out):
        patch = padded[:, i * stride : i * stride + size, j * stride : j * stride + size]
        y[:, i, j] = np.einsum("nhwc,hwco->no", patch, kernel)
    return y


def drawn(*shape: int) -> np.ndarray:
    return np.random.default_rng(sum(shape)).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("form", ["platform's", "shifts", "groups"])
@pytest.mark.parametrize(
    ("size", "stride", "hw"), [(3, 1, (7, 6)), (5, 2, (8, 12)), (3, 2, (7, 8)), (5, 1, (4, 4))]
)
def test_depthwise_in_every_form(form, size, stride, hw):
    x, kernel, bias = drawn(2, *hw, 4), drawn(size, size, 4), drawn(4)
    expected = written_out(x, np.einsum("hwc,co->hwco", kernel, np.eye(4)), stride) + bias
    if form == "platform's":
        got = depthwise(x, Depthwise(kernel, bias), stride)
    else:
        got = {"shifts": layers._by_shifts, "groups": layers._by_groups}[form](x, kernel, stride) + bias
    np.testing.assert_allclose(got, expected, atol=2e-5)


@pytest.mark.parametrize(("size", "hw"), [(3, (8, 6)), (5, (12, 7))])
def test_full_convolution(size, hw):
    x, kernel, bias = drawn(2, *hw, 3), drawn(size, size, 3, 5), drawn(5)
    expected = written_out(x, kernel, 2) + bias
    np.testing.assert_allclose(convolve(x, Convolution(kernel, bias), 2), expected, atol=2e-5)


def test_linear_mixes_channels():
    x, kernel, bias = drawn(2, 3, 4, 5), drawn(5, 6), drawn(6)
    np.testing.assert_allclose(linear(x, Linear(kernel, bias)), x @ kernel + bias, atol=1e-5)


def test_twice_as_large_has_half_pixel_centres():
    x = np.broadcast_to(np.arange(4.0, dtype=np.float32)[None, None, :, None], (1, 2, 4, 1))
    row = [0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3]
    np.testing.assert_allclose(layers.twice_as_large(x)[0, :, :, 0], [row] * 4, atol=1e-6)


def test_activations():
    x = np.array([-2.0, -0.5, 0.0, 3.0, 7.0], np.float32).reshape(1, 5, 1, 1)
    slope = np.array([0.25], np.float32)
    np.testing.assert_allclose(layers.prelu(x, slope).ravel(), [-0.5, -0.125, 0, 3, 7])
    np.testing.assert_allclose(layers.relu6(x).ravel(), [0, 0, 0, 3, 6])
