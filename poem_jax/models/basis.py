"""Basis points: a fixed cloud about the root that carries image features (paper, "Point-Embedded
Intersection Sphere").
"""

import jax.numpy as jnp
import numpy as np

from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.sampling import sample_bilinear
from poem_jax.models.config import BasisConfig, BasisSampling, BehindCamera
from poem_jax.typing import Array, Float


def basis_points(config: BasisConfig) -> Float[np.ndarray, "basis 3"]:
    """Draw the basis points, metres about the root; the same for the same config, always."""
    rng = np.random.Generator(np.random.PCG64(config.seed))
    inside = np.empty((0, 3))
    while len(inside) < config.num_points:
        drawn = _draw(rng, config)
        inside = np.concatenate([inside, drawn[np.linalg.norm(drawn, axis=-1) <= config.radius]])
    return inside[: config.num_points].astype(np.float32)


def _draw(rng: np.random.Generator, config: BasisConfig) -> Float[np.ndarray, "point 3"]:
    size = (config.num_points, 3)
    if config.sampling is BasisSampling.BALL:
        return rng.uniform(-config.radius, config.radius, size)
    return rng.normal(0.0, config.radius / 2, size)


def projected_features(
    feature_maps: Float[Array, "batch view h w c"],
    cams: Cameras,
    points_world: Float[Array, "batch basis 3"],
    image_hw: tuple[int, int],
    behind: BehindCamera = BehindCamera.ZEROS,
) -> tuple[Float[Array, "batch view basis c"], Float[Array, "batch view basis 2"]]:
    """Sample every view's features where the points project (paper, eq. 5).

    Points that project outside the image sample zeros.

    Returns: the features, and the projections as shares (u / W, v / H) of the image; zero for points behind
    the camera, unless `behind` takes these as they are.
    """
    uv_px, depth = project(cams.K, cams.T_cam_from_world, points_world[:, None])
    uv_share = uv_px / jnp.array(image_hw[::-1], uv_px.dtype)
    cells_wh = jnp.array(feature_maps.shape[-3:-1][::-1], uv_px.dtype)
    sampled = sample_bilinear(feature_maps, uv_share * cells_wh)
    if behind is BehindCamera.MIRRORED:
        return sampled, uv_share
    seen = (depth > 0)[..., None]
    return jnp.where(seen, sampled, 0), jnp.where(seen, uv_share, 0)
