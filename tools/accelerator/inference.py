"""Time of inference, for `rows.Inference`."""

from functools import partial

import numpy as np

import poem_jax
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.models.config import Config
from poem_jax.models.precision import cast_weights
from poem_jax.training.config import Precision
from tools.accelerator.results import Figures
from tools.accelerator.timing import time_calls


def measure_inference(
    config: Config, precision: Precision, views: int, batch: int, *, packed: bool
) -> Figures:
    """Time calls of one shape; the images lie on the device, or with `packed` on the host.

    Returns: `per_second` (samples of all their views), `tflops` (products and convolutions) and what
    `Taken.figures` has.

    Raises: FloatingPointError: a result is not finite, so the figure would mean nothing.
    """
    import jax

    from tools.accelerator.flops import count_flops

    params = poem_jax.init(config, key=jax.random.key(0))
    if precision is Precision.BFLOAT16:
        params = cast_weights(params, config)
    images, cams, root = scene(config, views, batch)
    run = jax.jit(lambda p, i, c, r: poem_jax.apply(p, i, c, config=config, root_world=r))
    flops = count_flops(run, params, images, cams, root)
    if packed:
        prepared = poem_jax.prepare(params, config)
        call = lambda: poem_jax.infer(prepared, images, cams, root_world=root)  # noqa: E731
    else:
        call = partial(run, *jax.device_put((params, images, cams, root)))
    taken = time_calls(call)
    if not np.isfinite(call().vertices_world).all():
        raise FloatingPointError(f"vertices are not finite in {precision.value}")
    return {
        "per_second": batch / taken.median_s,
        "tflops": 1e-12 * flops / taken.median_s,
        **taken.figures(),
    }


def scene(config: Config, views: int, batch: int) -> tuple[np.ndarray, poem_jax.Cameras, np.ndarray]:
    """Return random images, cameras around the world's origin, and the origin as roots."""
    rng, (h, w) = np.random.default_rng(0), config.image_hw
    images = rng.integers(0, 256, (batch, views, h, w, 3), dtype=np.uint8)
    K = np.array([[3.0 * w, 0, w / 2], [0, 3.0 * w, h / 2], [0, 0, 1]], np.float32)
    R = rotation_from_axis_angle(rng.normal(size=(batch, views, 3)))
    T_cam_from_world = rigid(R, np.tile([0.0, 0.0, 0.6], (batch, views, 1))).astype(np.float32)
    cams = poem_jax.Cameras(np.tile(K, (batch, views, 1, 1)), T_cam_from_world)
    return images, cams, np.zeros((batch, 3), np.float32)
