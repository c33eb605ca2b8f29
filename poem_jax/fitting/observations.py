"""What a fit is given: 2D key points, how far to trust each of them, and the cameras that saw them."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from poem_jax.geometry.cameras import projection_jacobian
from poem_jax.typing import Array, Bool, Float


class Observations(NamedTuple):
    """Key points of one hand in calibrated views; the leading axes (say, of frames) are free."""

    uv_px: Float[Array, "*batch view joint 2"]
    """Pixels of the undistorted images, OpenPose order; NaN = unseen."""
    weights: Float[Array, "*batch view joint"]
    """Inverse variance of a pixel coordinate, on any scale: zero, negative or NaN = unseen, whatever the
    pixels are. None, where observations are given, stands for ones."""
    K: Float[Array, "*#batch view 3 3"]
    T_cam_from_world: Float[Array, "*#batch view 4 4"]
    """Metres. A camera with numbers that are not finite is unknown: its key points count as unseen."""


def clean(observations: Observations, frame_axis: int | None) -> Observations:
    """Return finite arrays of the same batch axes, with weight zero wherever a key point is unseen.

    Args:
        observations: as they were given.
        frame_axis: batch axis over which the mean weight of the seen key points is made 1, together with
            views and joints; None: over views and joints alone.
    """
    uv_px = jnp.asarray(observations.uv_px)
    K, T, known = _finite_cameras(observations.K, observations.T_cam_from_world, uv_px.shape[:-3])
    seen = jnp.all(jnp.isfinite(uv_px), axis=-1) & known[..., None]
    weights = jnp.ones(seen.shape, uv_px.dtype)
    if observations.weights is not None:
        weights = jnp.asarray(observations.weights, uv_px.dtype)
        seen = seen & jnp.isfinite(weights) & (weights > 0)
    weights = jnp.where(seen, weights, 0)
    axes = (-2, -1) if frame_axis is None else (frame_axis, -2, -1)
    total, count = (jnp.sum(x, axis=axes, keepdims=True) for x in (weights, seen))
    weights = weights * count / jnp.where(total > 0, total, 1)
    return Observations(jnp.where(seen[..., None], uv_px, 0), weights, K, T)


def point_information(
    points_world: Float[Array, "*batch joint 3"],
    seen: Observations,
    reweight: Callable[[Float[Array, "*batch view joint"]], Float[Array, "*batch view joint"]] | None = None,
) -> tuple[Float[Array, "*batch joint 3 3"], Float[Array, "*batch joint 3"]]:
    """Return sum_v w J^T J and sum_v w J^T r of every point: r its reprojection residuals, J = d r / d point.

    Args:
        points_world: metres.
        seen: clean observations; w are their weights.
        reweight: gives a factor of each weight from w |r|^2, as a robust kernel does; None = 1.
    """
    pixels, J = projection_jacobian(seen.K, seen.T_cam_from_world, points_world)
    residual, weights = pixels - seen.uv_px, seen.weights
    if reweight is not None:
        weights = weights * reweight(weights * jnp.sum(residual**2, axis=-1))
    weighted = weights[..., None, None] * J
    information = jnp.sum(weighted[..., :, None] * J[..., None, :], axis=(-3, -5))
    return information, jnp.sum(weighted * residual[..., None], axis=(-2, -4))


def _finite_cameras(
    K: Float[Array, "*#batch view 3 3"], T_cam_from_world: Float[Array, "*#batch view 4 4"], batch: tuple
) -> tuple[Float[Array, "*batch view 3 3"], Float[Array, "*batch view 4 4"], Bool[Array, "*batch view"]]:
    """Broadcast cameras over `batch`; those that are not finite become identities and are not known."""
    K, T = (jnp.broadcast_to(x, (*batch, *x.shape[-3:])) for x in map(jnp.asarray, (K, T_cam_from_world)))
    known = jnp.all(jnp.isfinite(K), (-2, -1)) & jnp.all(jnp.isfinite(T), (-2, -1))
    K = jnp.where(known[..., None, None], K, jnp.eye(3, dtype=K.dtype))
    return K, jnp.where(known[..., None, None], T, jnp.eye(4, dtype=T.dtype)), known
