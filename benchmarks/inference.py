"""How fast and how large is inference? `python benchmarks/inference.py [--rounds N]`.

Prints, for `v2-base` at 8, 4 and 1 views and `tiny` at 4 views, batch 1: the median milliseconds of a forward
pass, seconds of the first call with an empty and with a filled compilation cache, the peak memory of both
processes (the cold one compiles, the warm one reads its program from the cache), and below them all passes.
Every case runs in processes of its own, one after the other. Weights are random: they cost the same.

Wanted on 2 cores: `tiny` at 4 views <= 40 ms; `v2-base` at 8 views <= 3 s and <= 2.5 GB; first call <= 60 s,
from the cache <= 15 s.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

CASES = (("v2-base", 8), ("v2-base", 4), ("v2-base", 1), ("tiny", 4))
COLUMNS = ("median ms", "first call s", "from cache s", "cold GB", "warm GB")
LEAST_ROUNDS = 7


def main() -> None:
    """Print the table, or measure one case where `--case` is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=LEAST_ROUNDS, help=f"at least {LEAST_ROUNDS} (default)")
    parser.add_argument("--case", nargs=2, metavar=("PRESET", "VIEWS"), help="measure in this process")
    arguments = parser.parse_args()
    if arguments.rounds < LEAST_ROUNDS:
        parser.error(f"--rounds must be at least {LEAST_ROUNDS}; got {arguments.rounds}")
    if arguments.case:
        preset, views = arguments.case
        print(json.dumps(measure(preset, int(views), arguments.rounds)))
        return
    print(f"{'preset':10}{'views':>6}" + "".join(f"{title:>14}" for title in COLUMNS))
    for preset, views in CASES:
        print(f"{preset:10}{views:>6}" + _row(preset, views, arguments.rounds), flush=True)


def _row(preset: str, views: int, rounds: int) -> str:
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = (_in_a_process(preset, views, rounds, cache) for _ in range(2))
    passes_ms = [1000 * seconds for seconds in warm["seconds"]]
    cells = [
        f"{value:.1f}" for value in (statistics.median(passes_ms), cold["first_call"], warm["first_call"])
    ]
    cells += [f"{run['peak_gb']:.2f}" for run in (cold, warm)]
    passes = " ".join(f"{value:.1f}" for value in passes_ms)
    return "".join(f"{cell:>14}" for cell in cells) + f"\n{'':10}passes: {passes}"


def _in_a_process(preset: str, views: int, rounds: int, cache: str) -> dict:
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
    command = [sys.executable, __file__, "--case", preset, str(views), "--rounds", str(rounds)]
    return json.loads(subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE).stdout)


def measure(preset: str, views: int, rounds: int) -> dict:
    """Return seconds of the first call and of every later one, and this process's peak memory so far."""
    import jax

    import poem_jax

    config = poem_jax.preset(preset)
    params = jax.block_until_ready(poem_jax.init(config, key=jax.random.key(0)))
    call = _call(params, config, views)
    first_call = _seconds(call)
    seconds = [_seconds(call) for _ in range(rounds)]
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    return {"first_call": first_call, "seconds": seconds, "peak_gb": peak_gb}


def _call(params, config, views: int):
    """Return a call of `apply` on random images and cameras around one point."""
    import numpy as np

    import poem_jax
    from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle

    rng = np.random.default_rng(0)
    h, w = config.image_hw
    images = rng.integers(0, 256, (1, views, h, w, 3), dtype=np.uint8)
    K = np.tile(np.array([[3.0 * w, 0, w / 2], [0, 3.0 * w, h / 2], [0, 0, 1]], np.float32), (1, views, 1, 1))
    R = rotation_from_axis_angle(rng.normal(size=(1, views, 3)))
    T_cam_from_world = rigid(R, np.tile([0.0, 0.0, 0.6], (1, views, 1))).astype(np.float32)
    cams = poem_jax.Cameras(K, T_cam_from_world)
    root = np.zeros((1, 3), np.float32)
    return lambda: poem_jax.apply(params, images, cams, config=config, root_world=root)


def _seconds(call) -> float:
    import jax

    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
