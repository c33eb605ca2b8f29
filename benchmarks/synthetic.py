"""How fast are synthetic captures drawn? `python benchmarks/synthetic.py [--seconds S]`.

Prints complete 4-view samples per second of the benchmark distribution (128 x 128 crops, every effect), drawn
by 1 and 2 threads and by 2 processes in one interleaved run, and what the parts of a sample cost. Wanted: at
least 150 samples per second on 2 cores.
"""

import argparse
import sys
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from poem_jax.synthetic.dataset import SyntheticDataset

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from poem_jax.experiments.synthetic_benchmark import benchmark

VIEWS = 4
CHUNK = 16
ROUNDS = 5
TARGET = 150


@cache
def dataset() -> SyntheticDataset:
    """The dataset of this process."""
    return SyntheticDataset(benchmark, 0)


def draw(start: int) -> int:
    """Draw one chunk of samples; return how many."""
    for index in range(start, start + CHUNK):
        dataset().sample(index, VIEWS)
    return CHUNK


def rate(pool: Executor, workers: int, seconds: float) -> float:
    """Return samples per second over about `seconds`."""
    chunks = max(2, round(seconds * 50 / CHUNK)) * workers
    begin = time.perf_counter()
    done = sum(pool.map(draw, range(0, chunks * CHUNK, CHUNK)))
    return done / (time.perf_counter() - begin)


def parts_ms(samples: int = 40) -> dict[str, float]:
    """Return milliseconds of processor time per sample: scene, and pictures of `VIEWS` views."""
    begin = time.thread_time()
    for index in range(samples):
        dataset().draw_scene(index)
    scene = time.thread_time() - begin
    begin = time.thread_time()
    for index in range(samples):
        dataset().sample(index, VIEWS)
    whole = time.thread_time() - begin
    return {"scene": 1e3 * scene / samples, f"{VIEWS} pictures": 1e3 * (whole - scene) / samples}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0, help="per measurement")
    seconds = parser.parse_args().seconds
    draw(0)
    with (
        ThreadPoolExecutor(1) as one,
        ThreadPoolExecutor(2) as two,
        ProcessPoolExecutor(2, mp_context=get_context("spawn")) as processes,
    ):
        ways = {"1 thread": (one, 1), "2 threads": (two, 2), "2 processes": (processes, 2)}
        list(processes.map(draw, [0, 0]))
        rates = {name: [] for name in ways}
        for _ in range(ROUNDS):
            for name, (pool, workers) in ways.items():
                rates[name].append(rate(pool, workers, seconds / ROUNDS))
    base = np.median(rates["1 thread"])
    for name, values in rates.items():
        print(f"{name:12s} {np.median(values):6.1f} samples/s   x {np.median(values) / base:.2f}")
    for name, cost in parts_ms().items():
        print(f"{name:12s} {cost:6.2f} ms of processor time per sample")
    best = max(float(np.median(values)) for values in rates.values())
    print(f"wanted: {TARGET} on 2 cores; reached {best:.0f} ({best / TARGET:.2f} x)")


if __name__ == "__main__":
    main()
