"""How long does every preset take? `python benchmarks/systems.py [--preset NAME ...]`, for docs/models.md.

`infer(prepare(params, config), ...)` of one sample: 8 views, or what a system takes, of random pixels, with
fresh weights, which find no hand but cost the same. Each preset in a process of its own, with the allocator
settings of the `poem` command; the median of 7 calls after one that does not count, and the process's peak
memory, compiling included. For comparisons see `inference.py` and `against_release.py`.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time

from torch_release.turns import peak_gb  # beside this file

from poem_jax.io.allocator import SETTINGS
from poem_jax.models.presets import PRESETS

ROUNDS, VIEWS = 7, 8


def main() -> None:
    """Print a row for each preset, or time one where `--job` is given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", action="append", choices=PRESETS, help="repeatable; without it all")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.job:
        print(json.dumps(_time(given.job)))
        return
    print("| preset | views | seconds | peak GB |\n|---|---|---|---|")
    for name in given.preset or PRESETS:
        command = [sys.executable, __file__, "--job", name]
        environment = {**os.environ, "GLIBC_TUNABLES": SETTINGS}
        done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        found = json.loads(done.stdout.splitlines()[-1])
        print(f"| `{name}` | {found['views']} | {found['seconds']:.2f} | {found['gb']:.2f} |", flush=True)


def _time(name: str) -> dict:
    import jax
    import numpy as np

    import poem_jax
    from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
    from poem_jax.models.infer import infer_unchecked, prepare

    config, rng = poem_jax.preset(name), np.random.default_rng(0)
    least, most = config.view_range
    views = max(least, min(VIEWS, VIEWS if most is None else most))
    h, w = config.image_hw
    images = rng.integers(0, 256, (1, views, h, w, 3), dtype=np.uint8)
    K = np.array([[3.0 * w, 0, w / 2], [0, 3.0 * w, h / 2], [0, 0, 1]], np.float32)
    R = rotation_from_axis_angle(rng.normal(size=(1, views, 3)))
    T_cam_from_world = rigid(R, np.tile([0.0, 0.0, 0.8], (1, views, 1))).astype(np.float32)
    cams = poem_jax.Cameras(np.tile(K, (1, views, 1, 1)), T_cam_from_world, np.ones((1, views), bool))
    root = np.zeros((1, 3), np.float32) if config.takes_root else None
    prepared = prepare(poem_jax.init(config, key=jax.random.key(0)), config)
    times = []
    for _ in range(ROUNDS + 1):
        start = time.perf_counter()
        jax.block_until_ready(infer_unchecked(prepared, images, cams, root_world=root))
        times.append(time.perf_counter() - start)
    return {"views": views, "seconds": statistics.median(times[1:]), "gb": peak_gb()}


if __name__ == "__main__":
    main()
