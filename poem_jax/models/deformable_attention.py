"""Multi-scale deformable sampling (Zhu et al. 2021, Deformable DETR, eq. 3): every query reads a few points
of several maps, each head its own."""

import jax.numpy as jnp

from poem_jax.geometry.sampling import sample_levels
from poem_jax.typing import Array, Float


def sample_deformed(
    levels: tuple[Float[Array, "..."], ...],
    locations: Float[Array, "*batch query head level point 2"],
    weights: Float[Array, "*batch query head level point"],
) -> Float[Array, "*batch query c"]:
    """Sum weighted samples over maps and points; the heads' channels stand side by side.

    Args:
        levels: maps (*batch, h, w, c), each of its own resolution, with the channels of all heads.
        locations: shares (u / W, v / H) of the maps; outside [0, 1] a map is zero.
        weights: of the samples; of one query and head they usually sum to 1.
    """
    *batch, query, head, level, point, _ = locations.shape
    by_head = []
    for x in levels:
        *_, h, w, c = x.shape
        by_head.append(jnp.moveaxis(x.reshape(*batch, h, w, head, c // head), -2, -4))
    places = jnp.moveaxis(locations, -5, -3)
    samples = sample_levels(by_head, places.reshape(*batch, head, level, query * point, 2))
    samples = samples.reshape(*batch, head, level, query, point, -1)
    read = jnp.einsum("...hlqpc,...qhlp->...qhc", samples, weights.astype(samples.dtype))
    return jnp.reshape(read, (*batch, query, -1))
