"""Weights in half numbers: what makes a model compute in them.

A layer computes in the type of its weights (`layers.py`), so that trunk and decoder follow from this cast.
What must not lose digits does not: batch norms' and layer norms' weights are `Exact`, as are those of the
layers that give heat maps, offsets and the hand's parameters; statistics and constants (hand, template, basis
points) are not touched; cameras, projections and triangulation have no weights, and softmaxes and long sums
ask for float32 themselves (`at_least_float32`).
"""

from typing import Any

import jax
import jax.numpy as jnp

from poem_jax.models.config import ModelConfig
from poem_jax.models.layers import Exact
from poem_jax.models.network import weights_of_kind
from poem_jax.typing import Array, Params


def cast_weights(params: Params, config: ModelConfig, dtype: Any = jnp.bfloat16) -> Params:
    """Return parameters with the trainable weights of another type, `Exact` ones apart.

    `apply`, `prepare` and `forward` take the result; gradients through the cast are of the type of `params`.

    Args:
        params: from `init` or `load`, float32.
        config: the configuration that they were made with.
        dtype: what trunk and decoder compute in.
    """
    exact = weights_of_kind(config, Exact)

    def cast(path: tuple[Any, ...], leaf: Array) -> Array:
        return leaf if tuple(part.key for part in path) in exact else jnp.asarray(leaf, dtype)

    return {**params, "trainable": jax.tree_util.tree_map_with_path(cast, params["trainable"])}
