"""Reading in a thread: the order stays, and so does what comes before an error."""

import threading

import pytest

from poem_jax.io.reading_ahead import read_ahead


def gather(stream, seen):
    """Note the items of a stream until it breaks off."""
    for item, _ in stream:
        seen.append(item)


def test_items_come_in_order_with_what_was_read():
    assert list(read_ahead(range(7), lambda item: 10 * item)) == [(i, 10 * i) for i in range(7)]
    assert list(read_ahead([], str)) == []


def test_what_comes_next_is_read_meanwhile():
    third = threading.Event()
    stream = read_ahead(range(9), lambda item: third.set() if item == 2 else None)
    next(stream)
    assert third.wait(10)


def test_a_stream_that_breaks_off_gives_what_came_before():
    def broken():
        yield from range(3)
        raise OSError("the disk is gone")

    seen = []
    with pytest.raises(OSError, match="the disk is gone"):
        gather(read_ahead(broken(), str), seen)
    assert seen == [0, 1, 2]


def test_an_error_of_reading_comes_in_its_place():
    def read(item):
        return 1 / (item - 2)

    seen = []
    with pytest.raises(ZeroDivisionError):
        gather(read_ahead(range(5), read), seen)
    assert seen == [0, 1]
