"""Enlarging and reducing NHWC maps by whole factors.

Written as broadcasts and reshapes: `jax.image.resize` is 5 to 10 times slower on a CPU.
"""

import jax.numpy as jnp

from poem_jax.typing import Array, Float


def repeat_pixels(x: Float[Array, "image h w c"], factor: int) -> Float[Array, "image h2 w2 c"]:
    """Enlarge by repeating every pixel (nearest neighbour)."""
    image, h, w, c = x.shape
    tiled = jnp.broadcast_to(x[:, :, None, :, None], (image, h, factor, w, factor, c))
    return tiled.reshape(image, h * factor, w * factor, c)


def max_pool(x: Float[Array, "image h w c"], factor: int) -> Float[Array, "image h2 w2 c"]:
    """Reduce to the largest of every `factor` x `factor` pixels."""
    image, h, w, c = x.shape
    return jnp.max(x.reshape(image, h // factor, factor, w // factor, factor, c), (2, 4))


def double_bilinear(x: Float[Array, "image h w c"]) -> Float[Array, "image h2 w2 c"]:
    """Double the resolution bilinearly: pixel areas are split, samples beyond the border repeat the edge."""
    return _double_axis(_double_axis(x, 1), 2)


def _double_axis(x: Array, axis: int) -> Array:
    """New samples stand a quarter cell before and after each old centre, hence the weights 3/4 and 1/4."""
    size = x.shape[axis]
    first, last = (jnp.take(x, jnp.array([i]), axis=axis) for i in (0, size - 1))
    body = [slice(None)] * x.ndim
    body[axis] = slice(0, size - 1)
    before = jnp.concatenate([first, x[tuple(body)]], axis)
    body[axis] = slice(1, size)
    after = jnp.concatenate([x[tuple(body)], last], axis)
    pair = jnp.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after], axis + 1)
    return pair.reshape(*x.shape[:axis], 2 * size, *x.shape[axis + 1 :])
