"""Sines that tell where a feature comes from (Carion et al. 2020, DETR)."""

import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.models.convolution import Conv
from poem_jax.typing import Array, Bool, Float

_TEMPERATURE = 10000.0
_EPSILON = 1e-6
"""Added by the release to the number of views, rows and columns that its positions are divided by."""


def sine_code(uv_share: Float[Array, "*batch 2"], width: int) -> Float[Array, "*batch c"]:
    """Encode positions (u / W, v / H) by sines (Carion et al. 2020, DETR).

    y comes before x; sine and cosine of a frequency are interleaved.
    """
    half = width // 2
    frequency = 2 * np.pi * _TEMPERATURE ** (-2.0 * np.arange(half // 2) / half)
    angle = uv_share[..., ::-1, None] * jnp.asarray(frequency, uv_share.dtype)
    code = jnp.stack([jnp.sin(angle), jnp.cos(angle)], -1)
    return code.reshape(*uv_share.shape[:-1], width)


class ViewRowColumnCode(nnx.Module):
    """A code of view number, row and column, mixed to the width of the map (release, FACTS section 4).

    Positions count from 1 and are divided by their number, which for the views is that of the sample's valid
    ones. A code is F / 2 sines followed by F / 2 cosines of the same frequencies, F = c / 2.
    """

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        self.mix = Conv(3 * (width // 2), width, 1, bias=True, rngs=rngs)

    def __call__(
        self, view_mask: Bool[Array, "batch view"], map_hw: tuple[int, int]
    ) -> Float[Array, "batch view h w c"]:
        """Return what is added to each view's map; the mix is linear, so each axis is mixed alone."""
        assert self.mix.bias is not None
        to_view, to_row, to_column = jnp.split(self.mix.kernel[...][0, 0], 3)
        code = len(to_view)
        view_number = jnp.cumsum(view_mask, -1).astype(to_view.dtype)
        view_count = jnp.sum(view_mask, -1, keepdims=True).astype(to_view.dtype)
        views = axis_code(view_number, view_count, code) @ to_view
        rows, columns = (
            axis_code(jnp.arange(1.0, size + 1), jnp.array(float(size)), code) @ mix
            for size, mix in zip(map_hw, (to_row, to_column), strict=True)
        )
        return views[:, :, None, None] + rows[:, None] + (columns + self.mix.bias[...])


def axis_code(
    position: Float[Array, "*batch"], size: Float[Array, "*#batch"], width: int
) -> Float[Array, "*batch c"]:
    """Encode positions 1 .. size along one axis: sines, then cosines of p / 10000^(2 i / width)."""
    angle = position / (size + _EPSILON) * (2 * np.pi)
    period = _TEMPERATURE ** (2.0 * np.arange(width // 2) / width)
    angle = angle[..., None] / jnp.asarray(period, angle.dtype)
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)
