"""Batches ahead of time: an endless, exactly resumable stream drawn by threads.

Item i of the stream is `draw(i)`, so a stream that starts at step s equals the tail of one that started at 0,
whatever the number of workers. Threads serve better than processes here: the renderer's kernels release the
interpreter's lock, nothing is copied, and no worker imports JAX.
"""

from collections.abc import Callable, Generator
from types import ModuleType
from typing import TypeVar

_END = 2**62
"""As good as endless, and still an index."""

_T = TypeVar("_T")


def draw_ahead(draw: Callable[[int], _T], first: int, *, ahead: int, workers: int) -> Generator[_T]:
    """Yield `draw(first)`, `draw(first + 1)`, ... without end, in order.

    Args:
        draw: a pure function of the step; called from several threads.
        first: first step; a run resumes where its last checkpoint was.
        ahead: items drawn before they are asked for.
        workers: threads that draw.

    Raises:
        ModuleNotFoundError: Grain, an extra, is not installed.
        ValueError: sizes below 1 or a negative step. Errors of `draw` reach the caller at their step.
    """
    if min(ahead, workers) < 1 or first < 0:
        raise ValueError(
            "`ahead` and `workers` must be at least 1 and `first` at least 0; "
            f"got {ahead}, {workers} and {first}"
        )
    return _stream(_grain(), draw, first, ahead, workers)


def _grain() -> ModuleType:
    # Grain imports JAX: not at the top, or whoever draws samples would too.
    try:
        import grain
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("training needs Grain: pip install 'poem-jax[train]'") from error
    return grain


def _stream(
    grain: ModuleType, draw: Callable[[int], _T], first: int, ahead: int, workers: int
) -> Generator[_T]:
    options = grain.ReadOptions(num_threads=workers, prefetch_buffer_size=ahead)
    items = iter(grain.MapDataset.range(first, _END).map(draw).to_iter_dataset(options))
    try:
        yield from items
    finally:
        items.close()
