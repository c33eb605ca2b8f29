"""Dense layers of the decoder."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.typing import Array, Float

Initializer = Callable[..., Array]

xavier_uniform: Initializer = jax.nn.initializers.variance_scaling(1.0, "fan_avg", "uniform")
zeros: Initializer = jax.nn.initializers.zeros
_LAYER_NORM_EPSILON = 1e-5


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

    def __init__(self, channels: int) -> None:
        self.scale = nnx.Param(jnp.ones((channels,)))
        self.bias = nnx.Param(jnp.zeros((channels,)))

    def __call__(self, x: Float[Array, "*batch c"]) -> Float[Array, "*batch c"]:
        """Normalise."""
        centred = x - jnp.mean(x, -1, keepdims=True)
        variance = jnp.mean(centred**2, -1, keepdims=True)
        return centred * jax.lax.rsqrt(variance + _LAYER_NORM_EPSILON) * self.scale[...] + self.bias[...]
