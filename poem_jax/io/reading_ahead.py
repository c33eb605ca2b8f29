"""Read what comes next in a thread, while the caller works on what is there."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Read = TypeVar("_Read")


def read_ahead(
    items: Iterable[_Item], read: Callable[[_Item], _Read], depth: int = 2
) -> Iterator[tuple[_Item, _Read]]:
    """Yield each item with what `read` gives for it, in order; `depth` further ones are read meanwhile.

    One thread reads, one item after the other. Where the stream of items breaks off, the items before come
    first, and then its exception; one of `read` comes in the place of its item.
    """
    waiting: deque[tuple[_Item, Future[_Read]]] = deque()
    broken: Exception | None = None
    with ThreadPoolExecutor(1, "read-ahead") as thread:
        try:
            stream = iter(items)
            while True:
                try:
                    item = next(stream)
                except StopIteration:
                    break
                except Exception as error:
                    broken = error
                    break
                waiting.append((item, thread.submit(read, item)))
                if len(waiting) > depth:
                    yield _first(waiting)
            while waiting:
                yield _first(waiting)
        finally:
            for _, reading in waiting:
                reading.cancel()
    if broken is not None:
        raise broken


def _first(waiting: "deque[tuple[_Item, Future[_Read]]]") -> tuple[_Item, _Read]:
    item, reading = waiting.popleft()
    return item, reading.result()
