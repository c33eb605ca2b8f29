"""Values over the pipes between a run and its own workers: pickles, their arrays beside them, uncopied."""

import pickle
import struct
from typing import IO, Any, NamedTuple

UNREADABLE = (
    pickle.PickleError,
    ArithmeticError,
    AttributeError,
    ImportError,
    LookupError,
    TypeError,
    ValueError,
)
"""What a value raises that cannot be pickled, or a pickle whose classes are not those here."""

_COUNT, _LENGTH = struct.Struct("<I"), struct.Struct("<Q")


class Failure(NamedTuple):
    """An error of a sample, in the place of the sample, for the run to raise.

    Its home is not `worker.py`: a worker runs that as `__main__`, which is another module in the run.
    """

    error: Exception


def send(pipe: IO[bytes], value: Any) -> None:
    """Write a value and flush.

    Raises: OSError: nobody reads any more.
    """
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    parts = [memoryview(head), *(buffer.raw() for buffer in buffers)]
    pipe.write(_COUNT.pack(len(parts)) + b"".join(_LENGTH.pack(part.nbytes) for part in parts))
    for part in parts:
        pipe.write(part)
    pipe.flush()


def receive(pipe: IO[bytes]) -> Any:
    """Read what `send` wrote.

    Raises: EOFError: the other side has closed the pipe, or died.
    """
    (count,) = _COUNT.unpack(_read(pipe, _COUNT.size))
    lengths = [_LENGTH.unpack(_read(pipe, _LENGTH.size))[0] for _ in range(count)]
    head, *buffers = [_read(pipe, length) for length in lengths]
    return pickle.loads(head, buffers=buffers)


def _read(pipe: IO[bytes], length: int) -> bytearray:
    data = bytearray(length)
    view, done = memoryview(data), 0
    while done < length:
        read = pipe.readinto(view[done:])  # pyright: ignore[reportAttributeAccessIssue] - buffered readers have it
        if not read:
            raise EOFError("the other side of the pipe is gone")
        done += read
    return data
