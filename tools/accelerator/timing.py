"""Seconds of a call, the one that compiles apart, and in what its products are computed."""

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from poem_jax.training.config import Precision

LEAST_ROUNDS = 7
LEAST_S = 1.5
MOST_S = 10.0
"""After so long three rounds are enough."""
_FEW_ROUNDS = 3


class Taken(NamedTuple):
    """Of several calls."""

    first_s: float
    """With compiling."""
    median_s: float
    rounds: int

    def figures(self) -> dict[str, float | int]:
        """Return it as figures of a row."""
        return {"first_s": self.first_s, "ms": 1000 * self.median_s, "rounds": self.rounds}


@contextmanager
def products_in(precision: Precision) -> Iterator[None]:
    """Have float32 mean float32: by default a GPU rounds the factors of its products to TF32, 10 bits."""
    import jax

    if precision is Precision.FLOAT32:
        with jax.default_matmul_precision("highest"):
            yield
    else:
        yield


def time_calls(call: Callable[[], Any]) -> Taken:
    """Call once to compile and once to warm up, then until a median means something; each is waited for."""
    first = _seconds(call)
    _seconds(call)
    taken: list[float] = []
    while not _is_enough(len(taken), sum(taken)):
        taken.append(_seconds(call))
    return Taken(first, statistics.median(taken), len(taken))


def _is_enough(rounds: int, seconds: float) -> bool:
    return (rounds >= LEAST_ROUNDS and seconds >= LEAST_S) or (rounds >= _FEW_ROUNDS and seconds >= MOST_S)


def _seconds(call: Callable[[], Any]) -> float:
    import jax

    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start
