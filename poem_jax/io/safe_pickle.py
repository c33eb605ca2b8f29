"""Read pickles of arrays from untrusted files: an allow-list decides what may be built, and nothing else is.

A pickle is a program. This reader runs only the part of it that builds plain containers and descriptions of
arrays; NumPy's own constructors are never handed to it, for a forged dtype or array state can crash the
interpreter. When the whole pickle has been read, the descriptions, checked by then, become arrays. Classes of
other libraries that are known to hold arrays (scipy's sparse matrices, chumpy's variables) become inert
stand-ins that merely keep their state. Any other global is refused by name before anything of it is imported.
"""

import codecs
import contextlib
import functools
import io
import pickle
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from poem_jax.io.pickled_arrays import (
    ObjectDtype,
    PickledArray,
    PickledArrayOrDict,
    PickledDtype,
    describe_dtype,
    refuse_change,
)

_NUMPY_CORE = ("numpy.core", "numpy._core")
_BUILTINS = ("builtins", "__builtin__")
_DEEPEST = 100
_PLAIN = (str, bytes, int, float, bool, type(None))
_SIZED = (str, bytes, list, tuple, dict, set, frozenset)
_KEYS = {
    pickle.SETITEM: slice(-2, -1),
    pickle.SETITEMS: slice(0, None, 2),
    pickle.DICT: slice(0, None, 2),
    pickle.ADDITEMS: slice(None),
    pickle.FROZENSET: slice(None),
}
"""Where the keys lie on the reader's stack when an operation hashes them."""
_GIVEN = {
    pickle.REDUCE: slice(-1, None),
    pickle.BUILD: slice(-1, None),
    pickle.INST: slice(None),
    pickle.OBJ: slice(None),
}
"""Where that lies which an operation hands to a callable, which may copy it."""
_MAX_GIVEN, _GIVEN_BESIDES = 4, 2**16
"""In all, callables may be given this many items for each byte of the pickle, and this many."""


class StandIn:
    """Keeps the state that a pickle gives to an object of a foreign class, and does nothing."""

    module = ""
    name = ""
    state: dict[str, Any]
    __hash__ = None  # type: ignore[assignment]

    def __new__(cls, *args: Any) -> "StandIn":
        """Make it with an empty state: a pickle does not call `__init__`."""
        made = super().__new__(cls)
        made.state = {}
        return made

    def __setstate__(self, state: Any) -> None:
        # Objects with slots come as (dictionary, slots).
        parts = state if isinstance(state, tuple) else (state,)
        for part in parts:
            if isinstance(part, dict):
                self.state.update({_text(key): value for key, value in part.items()})

    def __repr__(self) -> str:
        return f"StandIn({self.module}.{self.name}: {sorted(self.state)})"


class Vocabulary(NamedTuple):
    """What a kind of file may say besides arrays and plain containers, and what each word becomes."""

    names: Mapping[tuple[str, str], Any] = {}
    """(module, name) of a global to what stands for it: an `Inert`, never the real thing."""
    stand_ins: Callable[[str, str], bool] = lambda module, name: False
    """True for the (module, name) of a class that may be replaced by a `StandIn`."""
    persistent: Callable[[Any], Any] | None = None
    """Describes an object outside the pickle by its id, whatever that is; None refuses them all."""
    array_of_dict: bool = False
    """True: an array without axes may hold one dict, as `np.save(path, {...})` writes it."""
    advice: str = "Do not trust this file."
    """Ends the message about a global that is refused."""


def load_arrays_pickle(
    path: str | Path, stand_ins: Callable[[str, str], bool] = lambda module, name: False
) -> Any:
    """Read a pickle that may hold NumPy arrays, plain containers and allowed stand-ins.

    Args:
        path: the file; pickles of Python 2 are read with latin-1 strings.
        stand_ins: True for the (module, name) of a class that may be replaced by a `StandIn`. The state of
            a stand-in is whatever the file says, itself included: follow it with care.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no pickle, is cut short, asks for a global outside the allow-list, or
            describes arrays that are not of plain numbers or not of the size of their bytes.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}; give the path of a pickle of arrays")
    return loads_arrays_pickle(path.read_bytes(), stand_ins=stand_ins, source=str(path))


def loads_arrays_pickle(
    data: bytes,
    stand_ins: Callable[[str, str], bool] = lambda module, name: False,
    source: str = "the pickle",
    *,
    array_of_dict: bool = False,
) -> Any:
    """Read a pickle from memory; see `load_arrays_pickle`.

    Args:
        data: the pickle.
        stand_ins: as there.
        source: names the pickle in messages.
        array_of_dict: an array without axes may hold one dict, and is given as the list [dict].
    """
    vocabulary = Vocabulary(stand_ins=stand_ins, array_of_dict=array_of_dict)
    with _problems_named(source):
        described = _Reader(io.BytesIO(data), vocabulary, source).load()
        return _Finisher().finish(described)


def describe_pickle(stream: io.BytesIO, vocabulary: Vocabulary, source: str) -> Any:
    """Read one pickle and leave the stream right behind it; arrays stay the descriptions that they are.

    Args:
        stream: holds the pickle, and perhaps more after it.
        vocabulary: what the pickle may say besides arrays and plain containers.
        source: names the pickle in messages.

    Returns:
        Containers of plain values, of `PickledArray`s and of what the vocabulary makes; they may hold
        themselves.

    Raises:
        ValueError: as for `load_arrays_pickle`, and whatever the vocabulary refuses.
    """
    with _problems_named(source):
        return _Reader(stream, vocabulary, source).load()


@contextlib.contextmanager
def _problems_named(source: str) -> Iterator[None]:
    """Turn whatever stops the reader into one ValueError that names the file."""
    try:
        yield
    except _Refused as error:
        raise ValueError(str(error)) from None
    except RecursionError as error:
        raise ValueError(f"{source} nests too deeply to be a file of arrays") from error
    except Exception as error:
        raise ValueError(
            f"{source} must be a whole pickle of arrays; reading it stopped with "
            f"{type(error).__name__}: {error}. Is the file cut short or of another kind? Fetch it again."
        ) from error


class _Refused(Exception):
    """A global outside the allow-list."""


# Python's own reader, not the one in C: that one allocates whatever a memo number or a length asks for.
class _Reader(pickle._Unpickler):
    dispatch: ClassVar[dict] = dict(pickle._Unpickler.dispatch)  # type: ignore[attr-defined]

    def __init__(self, stream: io.BytesIO, vocabulary: Vocabulary, source: str):
        super().__init__(stream, encoding="latin1")
        self._vocabulary = vocabulary
        self._source = source
        self._stream, self._start, self._given = stream, stream.tell(), 0

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            allowed = _ALLOWED[module, name]
            return _ARRAY_OR_DICT if self._vocabulary.array_of_dict and allowed is _ARRAY else allowed
        if (module, name) in self._vocabulary.names:
            return self._vocabulary.names[module, name]
        if self._vocabulary.stand_ins(module, name):
            return type("StandIn", (StandIn,), {"module": module, "name": name})
        raise _Refused(
            f"{self._source} asks for {module}.{name}, which is not needed to hold arrays and is refused; "
            f"expected only arrays and plain containers. {self._vocabulary.advice}"
        )

    def persistent_load(self, pid: Any) -> Any:
        if self._vocabulary.persistent is not None:
            return self._vocabulary.persistent(pid)
        raise _Refused(f"{self._source} refers to an object outside itself, which is refused")

    def count_given(self, values: list) -> None:
        """A short pickle could hand one long list to many calls, and fill the memory with copies."""
        parts = (part for value in values if isinstance(value, tuple) for part in value)
        self._given += sum(len(part) for part in (*values, *parts) if isinstance(part, _SIZED))
        if self._given > _MAX_GIVEN * (self._stream.tell() - self._start) + _GIVEN_BESIDES:
            raise ValueError("it uses the same contents again and again")

    def get_extension(self, code: int) -> Any:
        raise _Refused(f"{self._source} refers to a registered extension ({code}), which is refused")


def _with_plain_keys(operation: Callable[[Any], None], where: slice) -> Callable[[Any], None]:
    def checked(reader: Any) -> None:
        # Hashing deeply nested tuples overflows the interpreter's stack.
        check_keys(reader.stack[where])
        operation(reader)

    return checked


def check_keys(keys: Any) -> None:
    """Allow keys of plain values alone.

    Raises:
        ValueError: one of `keys` is a container or a description.
    """
    for key in keys:
        if not isinstance(key, _PLAIN):
            raise ValueError(f"keys must be text or numbers; got a {type(key).__name__}")


def _with_counted_gifts(operation: Callable[[Any], None], where: slice) -> Callable[[Any], None]:
    def counted(reader: Any) -> None:
        reader.count_given(reader.stack[where])
        operation(reader)

    return counted


for _code, _where in _GIVEN.items():
    _Reader.dispatch[_code[0]] = _with_counted_gifts(_Reader.dispatch[_code[0]], _where)
for _code, _where in _KEYS.items():
    _Reader.dispatch[_code[0]] = _with_plain_keys(_Reader.dispatch[_code[0]], _where)
# A bytearray would be allocated before it is known whether the file is that long.
_Reader.dispatch[pickle.BYTEARRAY8[0]] = _Reader.dispatch[pickle.BINBYTES8[0]]


class _Finisher:
    """Puts arrays in the place of their descriptions: in place but for tuples, each object once."""

    def __init__(self) -> None:
        # The original is kept beside what became of it, so that its id is not given to another object.
        self._done: dict[int, tuple[Any, Any]] = {}

    def finish(self, value: Any, depth: int = 0) -> Any:
        """Return what stands for `value` in the result.

        Raises:
            ValueError: containers too deep in each other, a tuple within itself, or something that is
                neither data nor a container of data.
        """
        if isinstance(value, _PLAIN):
            return value
        if depth > _DEEPEST:
            raise ValueError(f"containers nest more than {_DEEPEST} deep")
        if id(value) not in self._done:
            # Lists, dictionaries and stand-ins stay who they are, so they may hold themselves.
            self._done[id(value)] = (value, _UNFINISHED if isinstance(value, tuple) else value)
            self._done[id(value)] = (value, self._finished(value, depth + 1))
        finished = self._done[id(value)][1]
        if finished is _UNFINISHED:
            raise ValueError("a tuple holds itself")
        return finished

    def _finished(self, value: Any, depth: int) -> Any:
        if isinstance(value, PickledArray):
            made = value.array()
            return self.finish(made, depth) if isinstance(made, list) else made
        if isinstance(value, tuple):
            return tuple([self.finish(part, depth) for part in value])
        if isinstance(value, StandIn):
            # Some keep the type of their numbers beside these, which tells it themselves.
            value.state = {
                key: v for key, v in value.state.items() if not isinstance(v, PickledDtype | ObjectDtype)
            }
            self.finish(value.state, depth)
        elif isinstance(value, dict):
            for key in value:
                value[key] = self.finish(value[key], depth)
        elif isinstance(value, list):
            value[:] = [self.finish(part, depth) for part in value]
        elif not isinstance(value, set | frozenset):
            raise ValueError(f"a {type(value).__name__} is no data")
        return value


_UNFINISHED = object()


class Inert:
    """A name that a pickle may mention but neither change nor use as anything but what we make of it."""

    __slots__ = ("_build", "_name")

    def __init__(self, name: str, build: Callable[..., Any] | None = None):
        """Take the name, for messages, and what a call of it builds; `build` must bear any arguments."""
        self._name, self._build = name, build

    def __call__(self, *args: Any) -> Any:
        """Build what the pickle calls for.

        Raises:
            ValueError: nothing is built under this name.
        """
        if self._build is None:
            raise ValueError(f"{self._name} may not be called")
        return self._build(*args)

    def __setstate__(self, state: Any) -> None:
        refuse_change(self._name)


_NDARRAY = Inert("numpy.ndarray")
_OBJECT = Inert("object")


def _reconstruct(
    subtype: Any, shape: Any, dtype: Any, *, announced: type[PickledArray] = PickledArray
) -> PickledArray:
    """Announce an array that the pickle then fills; only true `ndarray`s."""
    if subtype is not _NDARRAY:
        raise ValueError("only plain numpy.ndarray can be rebuilt")
    if shape != (0,) or dtype not in ("b", b"b"):
        raise ValueError(
            "an array must start empty and of bytes, as NumPy writes it: no arrays of Python objects"
        )
    return announced()


_ARRAY = Inert("_reconstruct", _reconstruct)
_ARRAY_OR_DICT = Inert("_reconstruct", functools.partial(_reconstruct, announced=PickledArrayOrDict))


def _scalar(dtype: Any, data: Any = None) -> PickledArray:
    """Describe a NumPy scalar by its bytes."""
    return PickledArray().fill((), dtype, "C", data, scalar=True)


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> PickledArray:
    """Describe an array by a buffer (pickle protocol 5)."""
    if order not in ("C", "F"):
        raise ValueError("an array's order must be C or F")
    return PickledArray().fill(shape, dtype, order, data)


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    """Bytes as protocol 2 writes them; the only codec in use there is latin-1."""
    if not isinstance(text, str) or not isinstance(encoding, str):
        raise ValueError("bytes must be given as text and a codec")
    if codecs.lookup(encoding).name != "iso8859-1":
        raise ValueError(f"codec {encoding!r} is not read")
    return text.encode("latin1")


def _set(members: Any = ()) -> set:
    """Build a set of names, such as chumpy keeps."""
    if not isinstance(members, list | tuple):
        raise ValueError(f"a set must be given its members in a list; got a {type(members).__name__}")
    check_keys(members)
    return set(members)


class _OrderedDict(dict):
    """An OrderedDict or Counter; the attributes that a pickle sets on it (`_metadata`) are dropped."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, dict):
            raise ValueError(f"the attributes of a dict must come in a dict; got a {type(state).__name__}")


def _make_dict(items: Any = ()) -> _OrderedDict:
    """Build from nothing, from another dict, or from a list of pairs, as Python 2 wrote it."""
    pairs = list(items.items()) if isinstance(items, dict) else items
    whole = isinstance(pairs, list | tuple) and all(
        isinstance(pair, list | tuple) and len(pair) == 2 for pair in pairs
    )
    if not whole:
        raise ValueError("a dict must be given as pairs of key and value")
    check_keys([key for key, _ in pairs])
    return _OrderedDict(pairs)


def _new_stand_in(kind: Any, base: Any, state: Any) -> StandIn:
    """What protocols 0 and 1 call to make an object: here only a stand-in."""
    if not (isinstance(kind, type) and issubclass(kind, StandIn) and base is _OBJECT and state is None):
        raise ValueError("only stand-ins for known array classes can be rebuilt")
    return kind()


def _text(key: Any) -> str:
    return key.decode("latin1") if isinstance(key, bytes) else str(key)


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): Inert("numpy.dtype", describe_dtype),
    ("_codecs", "encode"): Inert("_codecs.encode", _encode),
    ("collections", "OrderedDict"): Inert("collections.OrderedDict", _make_dict),
    ("collections", "Counter"): Inert("collections.Counter", _make_dict),
    **{(f"{core}.multiarray", "_reconstruct"): _ARRAY for core in _NUMPY_CORE},
    **{(f"{core}.multiarray", "scalar"): Inert("scalar", _scalar) for core in _NUMPY_CORE},
    **{(f"{core}.numeric", "_frombuffer"): Inert("_frombuffer", _from_buffer) for core in _NUMPY_CORE},
    **{(name, "_reconstructor"): Inert("_reconstructor", _new_stand_in) for name in ("copyreg", "copy_reg")},
    **{(name, "object"): _OBJECT for name in _BUILTINS},
    **{(name, "set"): Inert("set", _set) for name in _BUILTINS},
}
