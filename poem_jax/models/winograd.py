"""3 x 3 convolutions by minimal filtering, F(2 x 2, 3 x 3) (Winograd 1980; Lavin and Gray 2016).

    Y = A^T [(G g G^T) * (B^T d B)] A          for every tile d of 4 x 4 pixels, every 2 x 2 pixels Y

The product is one of matrices over channels for each of the 16 places of a tile: 16 products where the plain
form takes 36. A CPU's matrix products run at nearly its full rate, XLA:CPU's convolutions at half of it.
Rounding errors are a few times those of the plain form. The gradient of the kernel is of the same form:

    dL/dg = G^T [ sum over tiles (B^T d B) * (A dL/dY A^T) ] G
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
    image, h, w, _ = x.shape
    tiles = _places_of_tiles(x)
    # Products one by one: XLA:CPU is slower at one of stacked matrices.
    by_column = [
        _out_of_tiles([place @ weights for place, weights in zip(row, kernels, strict=True)])
        for row, kernels in zip(tiles, kernel, strict=True)
    ]
    pixels = zip(*(_out_of_tiles(column) for column in zip(*by_column, strict=True)), strict=True)
    y = jnp.stack([jnp.stack(row, 3) for row in pixels], 2)
    rows, columns = y.shape[1], y.shape[3]
    return y.reshape(image, 2 * rows, 2 * columns, -1)[:, :h, :w]


def kernel_gradient(
    x: Float[Array, "image h w c_in"], gradient: Float[Array, "image h w c_out"]
) -> Float[Array, "3 3 c_in c_out"]:
    """Return the gradient of the plain kernel from that of the result, `x` being what was convolved."""
    image, h, w, c_out = gradient.shape
    rows, columns = -(-h // 2), -(-w // 2)
    whole = ((0, 0), (0, 2 * rows - h), (0, 2 * columns - w), (0, 0))
    pixels = jnp.pad(jax.lax.optimization_barrier(gradient), whole)
    pixels = pixels.reshape(image, rows, 2, columns, 2, c_out)
    by_row = _spread(pixels[:, :, 0], pixels[:, :, 1])
    spread = [_spread(row[..., 0, :], row[..., 1, :]) for row in by_row]
    products = [
        [_over_tiles(place, slope) for place, slope in zip(row, slopes, strict=True)]
        for row, slopes in zip(_places_of_tiles(x), spread, strict=True)
    ]
    stacked = jnp.stack([jnp.stack(row) for row in products])
    G = jnp.asarray(_G, stacked.dtype)
    found = jnp.einsum("ai,bj,abcd->ijcd", G, G, stacked, precision=jax.lax.Precision.HIGHEST)
    return found.astype(x.dtype)


def _over_tiles(a: Float[Array, "*tile c"], b: Float[Array, "*tile d"]) -> Float[Array, "c d"]:
    """Sum products over the tiles, in float32 at least: of half numbers the sum would lose its digits."""
    kept = jnp.promote_types(a.dtype, jnp.float32)
    return jnp.matmul(a.reshape(-1, a.shape[-1]).T, b.reshape(-1, b.shape[-1]), preferred_element_type=kept)


def _places_of_tiles(x: Float[Array, "image h w c"]) -> list[tuple[Array, Array, Array, Array]]:
    """Return B^T d B of all tiles, by row and column of the place in a tile."""
    image, h, w, c = x.shape
    rows, columns = -(-h // 2), -(-w // 2)
    # Else what `x` is computed from would be computed anew for every place of a tile.
    x = jax.lax.optimization_barrier(x)
    around = ((0, 0), (1, 2 * rows - h + 1), (1, 2 * columns - w + 1), (0, 0))
    pairs = jnp.pad(x, around).reshape(image, rows + 1, 2, columns + 1, 2, c)
    by_row = _into_tiles(pairs[:, :, 0], pairs[:, :, 1], axis=1)
    return [_into_tiles(row[..., 0, :], row[..., 1, :], axis=2) for row in by_row]


def _into_tiles(even: Array, odd: Array, axis: int) -> tuple[Array, Array, Array, Array]:
    """Return B^T d along one axis, of which the even and the odd pixels are given."""
    count = even.shape[axis] - 1
    d0, d1 = (jax.lax.slice_in_dim(pixels, 0, count, axis=axis) for pixels in (even, odd))
    d2, d3 = (jax.lax.slice_in_dim(pixels, 1, count + 1, axis=axis) for pixels in (even, odd))
    return d0 - d2, d1 + d2, d2 - d1, d1 - d3


def _out_of_tiles(m: Sequence[Array]) -> tuple[Array, Array]:
    """Return A^T m along one axis, of which the four places are given."""
    return m[0] + m[1] + m[2], m[1] - m[2] - m[3]


def _spread(first: Array, second: Array) -> tuple[Array, Array, Array, Array]:
    """Return A m along one axis, of which the two pixels are given."""
    return first, first + second, first - second, -second
