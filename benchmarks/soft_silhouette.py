"""How fast are soft silhouettes? `python benchmarks/soft_silhouette.py [--rounds N]`.

Prints the median milliseconds of 4 views x 128 px of the shipped hand (1538 faces), forward, and forward with
the gradient of the release's L1 loss with respect to the vertices, for three softnesses. Wanted: 500 ms for
both on 2 cores.
"""

import argparse
import os
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.render.soft import RELEASE_BLUR_RADIUS, RELEASE_SIGMA, soft_silhouette
from poem_jax.typing import Array

VIEWS = 4
HW = (128, 128)
TARGET_MS = 500


def scene() -> tuple[Array, Array]:
    """Return pixels (view, vert, 2) and depths of the hand, half a metre away, seen from four sides."""
    vertices = hand_mesh(default_hand(), np.zeros((16, 3), np.float32), np.zeros(10, np.float32)).vertices
    turns = rotation_from_axis_angle(np.array([[np.pi / 2, 0, 0], [0.6, 0.4, 0], [0, 0.8, 0.5], [0, 0, 1.5]]))
    T_cam_from_world = np.tile(np.eye(4), (VIEWS, 1, 1))
    T_cam_from_world[:, :3, :3] = turns
    T_cam_from_world[:, :3, 3] = np.array([0, 0, 0.5]) - turns @ vertices.mean(0)
    K = np.array([[400.0, 0, HW[1] / 2], [0, 400.0, HW[0] / 2], [0, 0, 1]])
    uv_px, depth = project(K, T_cam_from_world, vertices)
    return jnp.asarray(uv_px, jnp.float32), jnp.asarray(depth, jnp.float32)


def median_ms(call: Callable[[], Array], rounds: int) -> tuple[float, float]:
    """Return the median and the least wall time of a call; the first, which compiles, is not counted."""
    jax.block_until_ready(call())
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times)), min(times)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=15)
    rounds = parser.parse_args().rounds
    uv_px, depth = scene()
    faces = jnp.asarray(default_hand().faces)
    print(f"{VIEWS} views x {HW[0]} px, {len(faces)} faces; load {os.getloadavg()[0]:.1f}; median (least) ms")
    for name, sigma, radius in (
        ("release", RELEASE_SIGMA, RELEASE_BLUR_RADIUS),
        ("sigma 1e-5", 1e-5, None),
        ("sigma 1e-4", 1e-4, None),
    ):
        draw = jax.jit(
            lambda uv, sigma=sigma, radius=radius: soft_silhouette(
                uv, depth, faces, HW, sigma=sigma, blur_radius=radius
            )
        )
        mask = draw(uv_px + 3) > 0.5
        both = jax.jit(jax.value_and_grad(lambda uv, draw=draw, mask=mask: jnp.abs(draw(uv) - mask).mean()))
        forward, backward = (
            median_ms(lambda draw=draw: draw(uv_px), rounds),
            median_ms(lambda both=both: both(uv_px), rounds),
        )
        covered = float(mask.mean())
        print(
            f"{name:11s} forward {forward[0]:6.1f} ({forward[1]:.1f})   with gradient {backward[0]:6.1f} "
            f"({backward[1]:.1f})   hand covers {covered:.0%}; wanted {TARGET_MS}"
        )


if __name__ == "__main__":
    main()
