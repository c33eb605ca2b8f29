"""Projective aggregation: fuse the features of all views, per basis point, into one (paper, eq. 7-8).

Letters: f1 = feature of the primary view, fj = those of the source views, N = number of valid views.

The released weights were trained on tokens that are not features of a basis point: the samples of all
views, (view, channel, point) in memory, are read as (point, view, channel). So does the release's design, for
any number of valid views among the padded ones.
"""

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.config import AggregationConfig, Design, Similarity
from poem_jax.models.layers import DecoderRow, linear
from poem_jax.typing import Array, Bool, Float, Int

_POINTS_AT_A_TIME = 512
"""Points that are fused together: few enough for a CPU's cache."""


class ProjectiveAggregation(DecoderRow):
    """f1 + phi(sum_j theta(f1) . theta(fj) theta(fj)) / N, exactly f1 where one view is valid; or, for
    `Similarity.EQUAL`, all views alike."""

    def __init__(self, config: AggregationConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.is_release = config.design is Design.RELEASE
        self.all_alike = config.similarity is Similarity.EQUAL
        half = width // 2
        self.theta_in, self.theta_out = linear(width, width, rngs=rngs), linear(width, half, rngs=rngs)
        hidden = half if self.is_release else width
        self.phi_in, self.phi_out = linear(half, hidden, rngs=rngs), linear(hidden, width, rngs=rngs)
        self.similarity_scale = 1.0 / half if config.similarity is Similarity.MEAN else 1.0

    def __call__(
        self,
        features: Float[Array, "batch view basis c"],
        view_mask: Bool[Array, "batch view"],
        primary: Int[Array, " batch"],
    ) -> Float[Array, "batch basis c"]:
        """Fuse the valid views into view `primary`; the release's design wants the valid views first."""
        if self.is_release:
            features = row_major_tokens(features, jnp.sum(view_mask, axis=-1))
        batch, _, points, c = features.shape
        if points % _POINTS_AT_A_TIME or points == _POINTS_AT_A_TIME:
            return self.lean(self._fused)(features, view_mask, primary)

        def part(start: Array) -> Array:
            taken = jax.lax.dynamic_slice_in_dim(features, start, _POINTS_AT_A_TIME, axis=2)
            return self.lean(self._fused)(taken, view_mask, primary)

        parts = jax.lax.map(part, jnp.arange(0, points, _POINTS_AT_A_TIME))
        return jnp.moveaxis(parts, 0, 1).reshape(batch, points, c)

    def _fused(self, features: Array, view_mask: Array, primary: Array) -> Float[Array, "batch point c"]:
        theta = self.theta_out(jax.nn.relu(self.theta_in(features)))
        if self.all_alike:
            return _mean(features, view_mask) + self._phi(_mean(theta, view_mask))
        first = _view(theta, primary)
        source_mask = view_mask & (jnp.arange(view_mask.shape[-1]) != primary[:, None])
        similarity = self.similarity_scale * jnp.sum(theta * first[:, None], -1)
        weights = jnp.where(source_mask[..., None], similarity, 0)
        mixed = jnp.sum(weights[..., None] * theta, axis=1)
        count = jnp.sum(view_mask, axis=-1)[:, None, None]
        return _view(features, primary) + self._update(mixed, first, count)

    def _update(self, from_sources: Array, first: Array, count: Array) -> Float[Array, "batch point c"]:
        if self.is_release:
            from_sources = jnp.where(count == 1, first, from_sources)
        update = self._phi(from_sources) / jnp.maximum(count, 1)
        return update if self.is_release else jnp.where(count > 1, update, 0)

    def _phi(self, tokens: Array) -> Float[Array, "batch point c"]:
        return self.phi_out(jax.nn.relu(self.phi_in(tokens)))


def row_major_tokens(
    features: Float[Array, "batch view basis c"], count: Int[Array, " batch"]
) -> Float[Array, "batch view basis c"]:
    """Read each sample's first `count` views, (view, c, point) in memory, as (point, view, c).

    Returns: token (point, view) at [view, point]; entries of views from `count` on mean nothing.
    """
    batch, view, point, c = features.shape
    rows = jnp.swapaxes(features, -1, -2).reshape(batch, view * point, c)
    index = jnp.arange(point) * count[:, None, None] + jnp.arange(view)[:, None]
    index = jnp.minimum(index, view * point - 1).reshape(batch, view * point)
    tokens = jax.vmap(lambda table, i: table.at[i].get(mode="promise_in_bounds"))(rows, index)
    return tokens.reshape(features.shape)


def _view(
    values: Float[Array, "batch view basis c"], index: Int[Array, " batch"]
) -> Float[Array, "batch basis c"]:
    return jnp.take_along_axis(values, index[:, None, None, None], axis=1)[:, 0]


def _mean(
    values: Float[Array, "batch view basis c"], view_mask: Bool[Array, "batch view"]
) -> Float[Array, "batch basis c"]:
    """Average over the valid views; zero where there is none."""
    weights = view_mask / jnp.maximum(jnp.sum(view_mask, -1, keepdims=True), 1)
    return jnp.sum(weights[..., None, None].astype(values.dtype) * values, 1)
