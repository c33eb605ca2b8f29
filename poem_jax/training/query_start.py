"""Query embeddings that are alike from the start where queries are neighbours on the template.

The paper initialises them "randomly". Drawn each for itself, 799 vectors must learn one by one where on the
hand they are, from one offset each; drawn as random sines of the template's coordinates (Rahimi and Recht
2007), what one query learns holds for its neighbours. docs/tables.md has what that saved.
"""

from typing import Any

import jax
import numpy as np

from poem_jax.hand.model import HandModel, template_queries
from poem_jax.hand.topology import NUM_JOINTS, split_queries
from poem_jax.models.config import ModelConfig
from poem_jax.models.layers import PerQuery
from poem_jax.models.network import weights_of_kind
from poem_jax.typing import Array, Params

_RADIANS_PER_M = 15.0
"""Standard deviation of the sines' wave numbers along each axis."""


def with_smooth_queries(params: Params, config: ModelConfig, seed: int) -> Params:
    """Return parameters whose vectors for each query are random sines of its place on the template.

    e_i = sqrt(2) sin(W x_i + phi), x_i metres about the root joint, W normal, phi uniform: of mean 0 and
    variance about 1, as the paper's designs draw them.

    Args:
        params: fresh ones.
        config: that they were made with.
        seed: of W and phi.

    Raises:
        ValueError: the system has no such vectors.
    """
    tables = weights_of_kind(config, PerQuery)
    if not tables:
        raise ValueError(
            "`train.smooth_queries` is for systems with a learned vector for each query; "
            f"this {type(config).__name__} has none. Leave it out"
        )
    hand = HandModel(**params["constants"]["hand"])
    points = np.asarray(template_queries(hand, config.query_order))
    _, joints = split_queries(points, config.query_order)
    rng = np.random.default_rng(seed)

    def smooth(path: tuple[Any, ...], leaf: Array) -> Array:
        if tuple(part.key for part in path) not in tables:
            return leaf
        places = joints if len(leaf) == NUM_JOINTS else points
        waves = rng.normal(0.0, _RADIANS_PER_M, (3, leaf.shape[-1]))
        phases = rng.uniform(0.0, 2 * np.pi, leaf.shape[-1])
        return jax.numpy.asarray(np.sqrt(2.0) * np.sin(places @ waves + phases), leaf.dtype)

    return {**params, "trainable": jax.tree_util.tree_map_with_path(smooth, params["trainable"])}
