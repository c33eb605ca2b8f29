import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.models.point_features import ViewRowColumnCode, axis_code, sine_code


def test_sine_code_is_the_written_formula():
    width, uv = 16, np.array([[0.25, 0.75], [-0.5, 1.5]], np.float32)
    expected = np.zeros((2, width))
    for n, (u, v) in enumerate(uv):
        for axis, share in enumerate((v, u)):
            for i in range(width // 4):
                angle = 2 * np.pi * share / 10000 ** (2 * i / (width // 2))
                expected[n, axis * width // 2 + 2 * i] = np.sin(angle)
                expected[n, axis * width // 2 + 2 * i + 1] = np.cos(angle)
    np.testing.assert_allclose(sine_code(jnp.asarray(uv), width), expected, atol=1e-6)


def _written(k: int, size: int, width: int) -> np.ndarray:
    """The code of the k-th of `size` cells, number by number: sines, then cosines."""
    angle = k / (size + 1e-6) * 2 * np.pi
    divisor = [10000 ** (2 * (j // 2) / width) for j in range(width)]
    sines = [np.sin(angle / divisor[j]) for j in range(0, width, 2)]
    cosines = [np.cos(angle / divisor[j]) for j in range(1, width, 2)]
    return np.array(sines + cosines)


def test_axis_code_is_the_written_formula():
    for k, size in ((1, 8), (5, 8), (16, 16)):
        found = axis_code(jnp.array(float(k)), jnp.array(float(size)), 12)
        np.testing.assert_allclose(found, _written(k, size, 12), atol=1e-6)


def test_view_row_column_code_counts_valid_views_and_mixes_the_axes():
    width, hw = 8, (2, 3)
    module = ViewRowColumnCode(width, rngs=nnx.Rngs(0))
    module.mix.bias[...] += jnp.arange(8.0)
    mask = np.array([[True, False, True, True], [False, True, False, False]])
    found = np.asarray(module(jnp.asarray(mask), hw))
    for sample, row in enumerate(mask):
        for number, view in enumerate(np.flatnonzero(row), start=1):
            for y in range(hw[0]):
                for x in range(hw[1]):
                    code = np.concatenate(
                        [
                            _written(number, row.sum(), 4),
                            _written(y + 1, hw[0], 4),
                            _written(x + 1, hw[1], 4),
                        ]
                    )
                    expected = code @ np.asarray(module.mix.kernel)[0, 0] + np.asarray(module.mix.bias)
                    np.testing.assert_allclose(found[sample, view, y, x], expected, atol=1e-5)
