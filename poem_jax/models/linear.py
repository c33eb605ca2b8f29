"""Dense layers of the decoder."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.typing import Array, Float, PRNGKeyArray

Initializer = Callable[..., Array]

xavier_uniform: Initializer = jax.nn.initializers.variance_scaling(1.0, "fan_avg", "uniform")
zeros: Initializer = jax.nn.initializers.zeros


class Linear(nnx.Module):
    """Affine map of the last axis."""

    def __init__(
        self, c_in: int, c_out: int, *, bias: bool = True, init: Initializer = xavier_uniform, rngs: nnx.Rngs
    ) -> None:
        self.kernel = nnx.Param(init(rngs.params(), (c_in, c_out), jnp.float32))
        self.bias: Any = nnx.Param(jnp.zeros((c_out,))) if bias else None

    def __call__(self, x: Float[Array, "*batch c"]) -> Float[Array, "*batch c2"]:
        """Map."""
        y = x @ self.kernel[...]
        return y if self.bias is None else y + self.bias[...]


class LayerNorm(nnx.Module):
    """Normalise the last axis (Ba et al. 2016)."""

    def __init__(self, channels: int, epsilon: float = 1e-5) -> None:
        self.epsilon = epsilon
        self.scale = nnx.Param(jnp.ones((channels,)))
        self.bias = nnx.Param(jnp.zeros((channels,)))

    def __call__(self, x: Float[Array, "*batch c"]) -> Float[Array, "*batch c"]:
        """Normalise."""
        centred = x - jnp.mean(x, -1, keepdims=True)
        variance = jnp.mean(centred**2, -1, keepdims=True)
        return centred * jax.lax.rsqrt(variance + self.epsilon) * self.scale[...] + self.bias[...]


def dropout(x: Float[Array, "*shape"], rate: float, key: PRNGKeyArray | None) -> Float[Array, "*shape"]:
    """Set a share of the numbers to zero and enlarge the rest in proportion; without a key, do nothing."""
    if key is None or rate == 0:
        return x
    return jnp.where(jax.random.bernoulli(key, 1 - rate, x.shape), x / (1 - rate), 0)
