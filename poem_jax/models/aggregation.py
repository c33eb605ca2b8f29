"""Projective aggregation: fuse the features of all views, per basis point, into one (paper, eq. 7-8).

Letters: f1 = feature of the primary view, fj = those of the source views, N = number of valid views.
"""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.config import Similarity
from poem_jax.models.linear import Linear
from poem_jax.typing import Array, Bool, Float, Int


class ProjectiveAggregation(nnx.Module):
    """f1 + phi(sum_j theta(f1) . theta(fj) theta(fj)) / N; exactly f1 where one view is valid."""

    def __init__(self, width: int, similarity: Similarity, *, rngs: nnx.Rngs) -> None:
        half = width // 2
        self.theta_in, self.theta_out = Linear(width, width, rngs=rngs), Linear(width, half, rngs=rngs)
        self.phi_in, self.phi_out = Linear(half, width, rngs=rngs), Linear(width, width, rngs=rngs)
        self.similarity_scale = 1.0 / half if similarity is Similarity.MEAN else 1.0

    def __call__(
        self,
        features: Float[Array, "batch view basis c"],
        view_mask: Bool[Array, "batch view"],
        primary: Int[Array, " batch"],
    ) -> Float[Array, "batch basis c"]:
        """Fuse the valid views into view `primary`."""
        theta = self.theta_out(jax.nn.relu(self.theta_in(features)))
        source_mask = view_mask & (jnp.arange(view_mask.shape[-1]) != primary[:, None])
        similarity = self.similarity_scale * jnp.sum(theta * _view(theta, primary)[:, None], -1)
        weights = jnp.where(source_mask[..., None], similarity, 0)
        fused = self.phi_out(jax.nn.relu(self.phi_in(jnp.sum(weights[..., None] * theta, axis=1))))
        count = jnp.sum(view_mask, axis=-1)[:, None, None]
        return _view(features, primary) + jnp.where(count > 1, fused / jnp.maximum(count, 1), 0)


def _view(
    values: Float[Array, "batch view basis c"], index: Int[Array, " batch"]
) -> Float[Array, "batch basis c"]:
    return jnp.take_along_axis(values, index[:, None, None, None], axis=1)[:, 0]
