"""3 x 3 convolutions by minimal filtering, F(2 x 2, 3 x 3) (Winograd 1980; Lavin and Gray 2016).

    Y = A^T [(G g G^T) * (B^T d B)] A          for every tile d of 4 x 4 pixels, every 2 x 2 pixels Y

The product is one of matrices over channels for each of the 16 places of a tile: 16 products where the plain
form takes 36. A CPU's matrix products run at nearly its full rate, XLA:CPU's convolutions at half of it.
Rounding errors are a few times those of the plain form.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.typing import Array, Float

TILE = 4
_G = np.array([[1, 0, 0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0, 0, 1]])


def transformed(kernel: Float[Array, "*stack 3 3 c_in c_out"]) -> Float[Array, "*stack 4 4 c_in c_out"]:
    """Return G g G^T for every pair of channels."""
    G = jnp.asarray(_G, kernel.dtype)
    return jnp.einsum("ai,bj,...ijcd->...abcd", G, G, kernel, precision=jax.lax.Precision.HIGHEST)


def convolve(
    x: Float[Array, "image h w c_in"], kernel: Float[Array, "4 4 c_in c_out"]
) -> Float[Array, "image h w c_out"]:
    """Convolve with a transformed kernel, one pixel of zeros around the image, stride 1."""
    image, h, w, c_in = x.shape
    rows, columns = -(-h // 2), -(-w // 2)
    # Else what `x` is computed from would be computed anew for every place of a tile.
    x = jax.lax.optimization_barrier(x)
    around = ((0, 0), (1, 2 * rows - h + 1), (1, 2 * columns - w + 1), (0, 0))
    pairs = jnp.pad(x, around).reshape(image, rows + 1, 2, columns + 1, 2, c_in)
    by_row = _into_tiles(pairs[:, :, 0], pairs[:, :, 1], axis=1)
    tiles = [_into_tiles(row[..., 0, :], row[..., 1, :], axis=2) for row in by_row]
    # Products one by one: XLA:CPU is slower at one of stacked matrices.
    by_column = [
        _out_of_tiles([place @ weights for place, weights in zip(row, kernels, strict=True)])
        for row, kernels in zip(tiles, kernel, strict=True)
    ]
    pixels = zip(*(_out_of_tiles(column) for column in zip(*by_column, strict=True)), strict=True)
    y = jnp.stack([jnp.stack(row, 3) for row in pixels], 2)
    return y.reshape(image, 2 * rows, 2 * columns, -1)[:, :h, :w]


def _into_tiles(even: Array, odd: Array, axis: int) -> tuple[Array, Array, Array, Array]:
    """Return B^T d along one axis, of which the even and the odd pixels are given."""
    count = even.shape[axis] - 1
    d0, d1 = (jax.lax.slice_in_dim(pixels, 0, count, axis=axis) for pixels in (even, odd))
    d2, d3 = (jax.lax.slice_in_dim(pixels, 1, count + 1, axis=axis) for pixels in (even, odd))
    return d0 - d2, d1 + d2, d2 - d1, d1 - d3


def _out_of_tiles(m: Sequence[Array]) -> tuple[Array, Array]:
    """Return A^T m along one axis, of which the four places are given."""
    return m[0] + m[1] + m[2], m[1] - m[2] - m[3]
