"""Hand-written pickles that crash a lesser reader must end in a ValueError.

What could take the interpreter down with it is read in a child process with bounded memory.
"""

import pickle
import struct
import subprocess
import sys

import numpy as np
import pytest

from poem_jax.io.safe_pickle import StandIn, loads_arrays_pickle

_RECONSTRUCT = np.zeros(0).__reduce__()[0]
_FROM_BUFFER = np.zeros(1).__reduce_ex__(5)[0]
_SCALAR = np.float32(1).__reduce__()[0]
_MEMORY = 4 * 2**30

_CHILD = f"""
import resource
import sys
# Here, not by `preexec_fn`: that forks, which a process with JAX's threads must not.
resource.setrlimit(resource.RLIMIT_AS, ({_MEMORY}, {_MEMORY}))
from poem_jax.io.safe_pickle import StandIn, loads_arrays_pickle
try:
    read = loads_arrays_pickle(sys.stdin.buffer.read(), stand_ins=lambda m, n: m.startswith("chumpy"))
    print("read", read.astype(object) if hasattr(read, "astype") else type(read))
except ValueError as error:
    print("refused:", str(error)[:300])
"""


class Made:
    """Pickles as a call, and perhaps a state to set on its result."""

    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call


def array_of(dtype, shape: object = (4,), raw: object = b"\x41" * 32, version=1):
    return Made(_RECONSTRUCT, (np.ndarray, (0,), b"b"), (version, shape, dtype, False, raw))


def forged_dtype(flags=0):
    """Bytes that NumPy would take for pointers, while `hasobject` says that there are none."""
    fields = {"a": (np.dtype("O"), 0)}
    return Made(np.dtype, ("V8", False, True), (3, "|", None, ("a",), fields, 8, 1, flags))


def plain_state(order="<", size=-1):
    return (3, order, None, None, None, size, -1, 0)


def nested(depth: int, opening: bytes, closing: bytes) -> bytes:
    return opening * depth + b"K\x01" + closing * depth


DEEP_KEY = b"\x80\x02}" + nested(200_000, b"", b"\x85") + b"K\x01s."
CRASHING = {
    "forged dtype": pickle.dumps(array_of(forged_dtype())),
    "forged dtype in a buffer": pickle.dumps(Made(_FROM_BUFFER, (b"A" * 32, forged_dtype(), (4,), "C"))),
    "forged dtype of a scalar": pickle.dumps(Made(_SCALAR, (forged_dtype(), b"A" * 8))),
    "dtype of objects in __setstate__": pickle.dumps(array_of(np.dtype("O"))),
    "objects in __setstate__": pickle.dumps(array_of(np.dtype("O"), (1,), [1])),
    "bool dtype grown by its state": pickle.dumps(array_of(Made(np.dtype, ("f8",), plain_state(size=2**40)))),
    "length of a bytearray": b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"abc.",
    "length of bytes": b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"abc.",
    "hash of a deep tuple": DEEP_KEY,
    "deep tuple in a set": b"\x80\x04\x8f(" + nested(200_000, b"", b"\x85") + b"\x90.",
    "deep list": b"\x80\x02" + nested(200_000, b"]", b"a") + b".",
    "huge shape": pickle.dumps(array_of(np.dtype("f8"), (2**62, 2**62), b"")),
    "huge shape beside a zero": pickle.dumps(array_of(np.dtype("f8"), (0, 2**62, 2**62), b"")),
    "shape of many dimensions": pickle.dumps(array_of(np.dtype("f8"), (1,) * 100, b"A" * 8)),
    "negative shape": pickle.dumps(array_of(np.dtype("f8"), (-4,))),
    "infinite shape": pickle.dumps(array_of(np.dtype("f8"), (float("inf"),))),
}


@pytest.mark.parametrize("name", CRASHING)
def test_pickles_that_could_crash_are_refused(name: str):
    child = subprocess.run(
        [sys.executable, "-c", _CHILD],
        input=CRASHING[name],
        capture_output=True,
        timeout=60,
    )
    assert child.returncode == 0, child.stderr.decode()[-500:]
    assert child.stdout.startswith(b"refused: the pickle"), child.stdout


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.dtype("f8"), "PickledDtype is no data"),
        (np.ndarray, "is no data"),
        (Made(_RECONSTRUCT, (np.ndarray, (0,), b"b")), "announced but never given"),
        (Made(_RECONSTRUCT, (np.ndarray, (4,), b"O")), "must start empty"),
        (Made(_RECONSTRUCT, (np.memmap, (0,), b"b")), "memmap"),
        (array_of("f8"), "dtype of numbers; got a str"),
        (array_of(np.dtype("f8"), (5,)), "needs 40 bytes; got 32"),
        (array_of(np.dtype("f8"), [4]), "must be a tuple of sizes"),
        (array_of(np.dtype("f8"), (4,), version=7), "not one that NumPy writes"),
        (array_of(np.dtype([("a", "f8")])), "dtype 'V8' is refused"),
        (np.array(["text"]), "dtype 'U4' is refused: only plain numbers"),
        (np.array(["2026"], dtype="M8[s]"), "dtype 'M8' is refused"),
        (np.array([None]), "dtype 'O8' is refused"),
        (array_of(Made(np.dtype, ("f8",), plain_state(order="x"))), "state of dtype 'f8'"),
        (array_of(Made(np.dtype, ("f8",), (4, *plain_state()[1:], ()))), "state of dtype 'f8'"),
        (Made(np.dtype, (["f8"],)), "dtype of a list is refused"),
        (Made(set, ([(1, 2)],)), "keys must be text or numbers; got a tuple"),
        (Made(set, ("abc",)), "must be given its members in a list"),
        ({(1, 2): 3}, "keys must be text or numbers; got a tuple"),
        ({np.float32(1): 3}, "keys must be text or numbers; got a PickledArray"),
    ],
)
def test_what_numpy_would_not_write_is_named(value, message: str):
    with pytest.raises(ValueError, match=message):
        loads_arrays_pickle(pickle.dumps(value, protocol=2))


def test_finished_arrays_and_types_stay_as_they_are():
    dtype = b"cnumpy\ndtype\n(S'f8'\ntR(K\x03S'<'\nNNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    again = b"(K\x03S'>'\nNNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    with pytest.raises(ValueError, match="a finished dtype may not be changed"):
        loads_arrays_pickle(dtype + again + b".")
    scalar = b"cnumpy.core.multiarray\nscalar\n(" + dtype + b"S'AAAAAAAA'\ntR"
    with pytest.raises(ValueError, match="a finished array may not be changed"):
        loads_arrays_pickle(scalar + b"(K\x01)" + dtype + b"\x89S'AAAAAAAA'\ntb.")


def test_byte_orders_survive_and_arrays_may_be_written():
    read = loads_arrays_pickle(pickle.dumps([np.arange(3, dtype=">f4"), np.arange(6).reshape(2, 3).T]))
    np.testing.assert_array_equal(read[0], np.arange(3))
    assert read[0].dtype == np.dtype(">f4")
    assert read[1].flags.f_contiguous
    for array in read:
        array[0] = 7


def test_one_array_in_two_places_stays_one():
    array = np.arange(3.0)
    read = loads_arrays_pickle(pickle.dumps({"a": array, "b": (array, [array])}))
    assert read["a"] is read["b"][0]
    assert read["a"] is read["b"][1][0]


def test_sharing_does_not_multiply_the_work():
    value = [1.0]
    for _ in range(60):
        value = [value, value]
    assert len(loads_arrays_pickle(pickle.dumps(value))) == 2


def test_containers_may_hold_themselves_but_tuples_not():
    own: list = []
    own.append(own)
    read = loads_arrays_pickle(pickle.dumps(own))
    assert read[0] is read
    pair: tuple = ([],)
    pair[0].append(pair)
    with pytest.raises(ValueError, match="a tuple holds itself"):
        loads_arrays_pickle(pickle.dumps(pair))


def test_stand_ins_may_hold_themselves_and_names_of_changed_parts():
    data = (
        b"\x80\x02cchumpy.ch\nCh\n)\x81q\x00}q\x01(U\x01ah\x00U\x05dirtyc__builtin__\nset\n]U\x01xa\x85Rub."
    )
    read = loads_arrays_pickle(data, stand_ins=lambda module, name: module == "chumpy.ch")
    assert isinstance(read, StandIn)
    assert read.state["a"] is read
    assert read.state["dirty"] == {"x"}


def test_memo_numbers_take_no_memory():
    assert loads_arrays_pickle(b"\x80\x02K\x01r\xff\xff\xff\x7f.") == 1


def test_extensions_are_refused():
    with pytest.raises(ValueError, match="registered extension"):
        loads_arrays_pickle(b"\x80\x02\x82\x01.")
