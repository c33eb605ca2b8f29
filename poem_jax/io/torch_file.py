"""Read and write PyTorch checkpoints, without PyTorch and without running what is in them.

`torch.save` writes one of two forms. Since version 1.6 it is a zip archive, nothing in it compressed:
`<root>/data.pkl`, a pickle in which storages of numbers are named by a key, and `<root>/data/<key>`, their
bytes. Before it was a row of pickles (a magic number, the protocol, facts of the machine, the object, the
storages' keys), then for each key a count of numbers and the numbers. The pickles go through `safe_pickle`,
which allows the names of `torch_pickle` besides its own.
"""

import contextlib
import io
import math
import pickle
import struct
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.io.pickled_arrays import PickledArray, PickledTensor, TensorStorage
from poem_jax.io.torch_pickle import DTYPES, describe, make_storage

_MAGIC = 0x1950A86A20F9469CFC6C
_PROTOCOL = 1001
_USUAL_NAMES = ("state_dict", "model_state_dict", "model", "net", "network")
_MAX_GROWTH, _MAX_BESIDES = 16, 2**26
"""The arrays may take this many times the file's size, and this many bytes: tensors may share storages."""
_MAX_CAUSE = 300
"""Characters of zipfile's message, which quotes what stands in the place of a name, that are passed on."""
_ZIP_PROBLEMS = (
    zipfile.BadZipFile,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    OverflowError,
    ValueError,
    struct.error,
)
"""What `zipfile` raises where an archive is damaged."""


def load_state_dict(path: str | Path) -> dict[str, np.ndarray]:
    """Read the state dict of a file that `torch.save` wrote, in either form.

    It is a dict of arrays right inside the file's dict under a usual name ("state_dict", "model_state_dict",
    "model", "net", "network"), else the file's dict itself, else the only dict of arrays in it. What is not
    an array is left out, as is all that stands beside the state dict (epoch, optimizer, ...).

    Returns:
        Keys as they stand in the file ("module." stays) to arrays in the machine's byte order, in C order,
        each with memory of its own; bfloat16 as `ml_dtypes.bfloat16`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not of `torch.save`, is cut short or damaged, is a TorchScript archive, asks
            for a global outside the allow-list, describes tensors beyond their storages, or has no state
            dict.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}; give the path of a PyTorch checkpoint")
    with path.open("rb") as stream:
        form = _ZipForm if stream.read(4) == b"PK\x03\x04" else _LegacyForm
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        file = form(stream, str(path))
        stored = _find_state_dict(file.described, str(path))
        total = sum(value.nbytes for value in stored.values())
        if total > _MAX_GROWTH * size + _MAX_BESIDES:
            raise ValueError(f"the arrays of {path} would take {total} bytes, far more than its {size}")
        return _read_arrays(stored, file)


def save_state_dict(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays so that `torch.load(path, weights_only=True)` gives an OrderedDict of tensors.

    Args:
        path: where to write; the file is whole or absent.
        arrays: keys to arrays of any shape and byte order, of float16/32/64, bfloat16 (`ml_dtypes`),
            int8/16/32/64, uint8 or bool. Arrays that share memory are written apart.

    Raises:
        ValueError: no arrays, a key that is no text, or another type of numbers.
    """
    if not arrays:
        raise ValueError("`arrays` must hold at least one array; got none")
    for key, array in arrays.items():
        if not isinstance(key, str):
            raise ValueError(f"keys of `arrays` must be text; got a {type(key).__name__}")
        if array.dtype.newbyteorder("=") not in DTYPES.values():
            known = ", ".join(str(dtype) for dtype in DTYPES.values())
            raise ValueError(f"array {key!r} must be of {known}; got {array.dtype}. Convert it first")
    with whole_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        _write(archive, "data.pkl", _pickled(arrays))
        _write(archive, "byteorder", b"little")
        for index, array in enumerate(arrays.values()):
            _write(archive, f"data/{index}", _little_endian(array))
        _write(archive, "version", b"3\n")


class _ZipForm:
    """A zip archive: what its pickle says, and the numbers of its storages."""

    def __init__(self, stream: BinaryIO, source: str):
        self._source = source
        with self._problems_named():
            self._archive = zipfile.ZipFile(stream)
        self._entries = {entry.filename: entry for entry in self._archive.infolist()}
        self._root = self._find_root()
        self._check_entries(stream.seek(0, io.SEEK_END))
        byteorder = self._read("byteorder") if f"{self._root}/byteorder" in self._entries else b"little"
        if byteorder not in (b"little", b"big"):
            raise ValueError(f"the byte order of {source} must be little or big; got {byteorder[:20]!r}")
        self._order = "<" if byteorder == b"little" else ">"
        self.described = describe(io.BytesIO(self._read("data.pkl")), source, self._storage)

    def numbers(self, storage: TensorStorage) -> np.ndarray:
        """Read all numbers that an entry of the archive holds."""
        return _decode(self._read(f"data/{storage.key}"), storage.dtype, self._order)

    def _storage(self, pid: Any) -> TensorStorage:
        storage = make_storage(pid, length=5)
        entry = self._entries.get(f"{self._root}/data/{storage.key}")
        held = 0 if entry is None else entry.file_size
        if entry is None or storage.nbytes > held:
            raise ValueError(f"storage {storage.key[:20]!r} must have {storage.nbytes} bytes; got {held}")
        return storage

    def _check_entries(self, size: int) -> None:
        """Refuse what could unpack to more than the file, or be read in two ways."""
        listed = self._archive.infolist()
        if len(listed) != len(self._entries):
            raise ValueError(f"{self._source} holds two files of one name, which torch.save never writes")
        for entry in listed:
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size:
                raise ValueError(
                    f"{entry.filename[:40]!r} in {self._source} is compressed, which torch.save never does"
                )
        if sum(entry.file_size for entry in listed) > size:
            raise ValueError(f"{self._source} says that it holds more than its {size} bytes; fetch it again")

    def _find_root(self) -> str:
        split = [name.split("/") for name in self._entries]
        if any(parts[1:] in (["constants.pkl"], ["model.json"]) for parts in split):
            raise ValueError(
                f"{self._source} is a TorchScript archive, a program; expected the file of a state dict. "
                "Save one with `torch.save(model.state_dict(), path)`"
            )
        roots = [parts[0] for parts in split if parts[1:] == ["data.pkl"]]
        if len(roots) != 1:
            raise ValueError(
                f"{self._source} is a zip archive, but not of torch.save: expected one data.pkl, "
                f"got {len(roots)}"
            )
        return roots[0]

    def _read(self, name: str) -> bytes:
        with self._problems_named():
            return self._archive.read(self._entries[f"{self._root}/{name}"])

    @contextlib.contextmanager
    def _problems_named(self) -> Iterator[None]:
        try:
            yield
        except _ZIP_PROBLEMS as error:
            raise ValueError(
                f"{self._source} must be a whole zip archive of torch.save; reading it stopped with "
                f"{type(error).__name__}: {str(error)[:_MAX_CAUSE]}. Is the file cut short or damaged? "
                "Fetch it again."
            ) from error


class _LegacyForm:
    """A row of pickles: what the object's says, and the numbers behind the last."""

    def __init__(self, stream: BinaryIO, source: str):
        self._source, self._data = source, stream.read()
        self._storages: dict[str, TensorStorage] = {}
        pickles = io.BytesIO(self._data)
        self._check_magic(pickles)
        # The machine's facts do not matter: numbers are little-endian on every machine.
        describe(pickles, source)
        self.described = describe(pickles, source, self._storage)
        self._positions = self._find_numbers(describe(pickles, source), pickles.tell())

    def numbers(self, storage: TensorStorage) -> np.ndarray:
        """Read all numbers of a storage."""
        start = self._positions[storage.key]
        stop = start + self._storages[storage.key].nbytes
        return _decode(self._data[start:stop], storage.dtype, "<")

    def _check_magic(self, pickles: io.BytesIO) -> None:
        for expected in (_MAGIC, _PROTOCOL):
            try:
                found = describe(pickles, self._source)
            except ValueError as error:
                raise ValueError(f"{self._source} is no file of torch.save, or cut short: {error}") from error
            if found != expected:
                raise ValueError(
                    f"{self._source} is no file of torch.save: it starts neither as a zip archive nor with "
                    f"torch's magic number and protocol {_PROTOCOL}"
                )

    def _storage(self, pid: Any) -> TensorStorage:
        """Describe a storage or, where the id ends in (key, start, count), that part of it."""
        storage = make_storage(pid, length=6)
        known = self._storages.setdefault(storage.key, storage)
        if (known.dtype, known.numel) != (storage.dtype, storage.numel):
            raise ValueError(f"storage {storage.key[:20]!r} has two types or sizes")
        if pid[5] is None:
            return storage
        if not isinstance(pid[5], tuple) or len(pid[5]) != 3:
            raise ValueError("a part of a storage must be a key, a start and a count")
        return storage.part(*pid[5][1:])

    def _find_numbers(self, keys: Any, position: int) -> dict[str, int]:
        """Walk over the storages, which start at `position`; return where the numbers of each start."""
        if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
            raise ValueError(f"{self._source} must list the keys of its storages")
        if len(keys) != len(self._storages) or set(keys) != set(self._storages):
            raise ValueError(
                f"{self._source} must hold the {len(self._storages)} storages that its pickle names, once "
                f"each; got {len(keys)} others"
            )
        positions = {}
        for key in keys:
            expected = self._storages[key]
            count = int.from_bytes(self._data[position : position + 8], "little")
            positions[key] = position + 8
            position += 8 + expected.nbytes
            if position > len(self._data):
                raise ValueError(f"{self._source} is cut short in storage {key[:20]!r}; fetch it again")
            if count != expected.numel:
                raise ValueError(f"storage {key[:20]!r} must have {expected.numel} numbers; got {count}")
        return positions


def _decode(raw: bytes, dtype: np.dtype, order: str) -> np.ndarray:
    """Make numbers of the machine's byte order from as many bytes as are whole numbers."""
    bits = np.frombuffer(raw, f"{order}u{dtype.itemsize}", count=len(raw) // dtype.itemsize)
    if dtype == np.bool_:
        return bits != 0
    return bits.astype(f"=u{dtype.itemsize}", copy=False).view(dtype)


def _find_state_dict(described: Any, source: str) -> dict[str, PickledArray | PickledTensor]:
    """Choose the state dict: a usual name, else the dict with most arrays; see `load_state_dict`."""
    if not isinstance(described, dict):
        raise ValueError(f"{source} must hold a dict; got a {type(described).__name__}")
    for name in _USUAL_NAMES:
        if _is_of_arrays(described.get(name)):
            return _arrays_in(described[name])
    # Each value once, whatever the number of its names.
    distinct = {id(value): value for value in described.values()}
    dicts = {identity: value for identity, value in distinct.items() if _is_of_arrays(value)}
    largest = max((len(_arrays_in(value)) for value in dicts.values()), default=0)
    if _is_of_arrays(described) and len(_arrays_in(described)) >= largest:
        return _arrays_in(described)
    if len(dicts) == 1:
        return _arrays_in(next(iter(dicts.values())))
    names = [key for key, value in described.items() if id(value) in dicts]
    raise ValueError(
        f"{source} must be a state dict or hold one under one of the names {', '.join(_USUAL_NAMES)}; "
        f"its keys are {_listed(list(described))}, and those of dicts of arrays {_listed(names)}"
    )


def _is_of_arrays(value: Any) -> bool:
    """Tell whether more than half of a dict's values are arrays."""
    return isinstance(value, dict) and 2 * len(_arrays_in(value)) > len(value)


def _arrays_in(values: dict) -> dict[str, PickledArray | PickledTensor]:
    return {
        key: value
        for key, value in values.items()
        if isinstance(key, str) and isinstance(value, PickledArray | PickledTensor)
    }


def _listed(keys: list) -> str:
    shown = [repr(key)[:40] for key in keys[:12]]
    return ", ".join(shown + ["..."] * (len(keys) > 12)) or "none"


def _read_arrays(
    stored: dict[str, PickledArray | PickledTensor], file: _ZipForm | _LegacyForm
) -> dict[str, np.ndarray]:
    """Make the true arrays, with one storage in memory at a time."""
    arrays = {
        key: np.asarray(value.array()) for key, value in stored.items() if isinstance(value, PickledArray)
    }
    sharing: dict[tuple[str, str], dict[str, PickledTensor]] = {}
    for key, value in stored.items():
        if isinstance(value, PickledTensor):
            sharing.setdefault((value.storage.key, value.storage.dtype.name), {})[key] = value
    for tensors in sharing.values():
        numbers = file.numbers(next(iter(tensors.values())).storage)
        arrays.update((key, tensor.array(numbers)) for key, tensor in tensors.items())
    return {key: arrays[key] for key in stored}


def _pickled(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Write the operations that rebuild an OrderedDict of tensors; storage i is that of array i."""
    items = b"".join(
        _plain(key) + _pickled_tensor(array, str(index)) for index, (key, array) in enumerate(arrays.items())
    )
    return pickle.PROTO + b"\x02" + _EMPTY_DICT + pickle.MARK + items + pickle.SETITEMS + pickle.STOP


def _pickled_tensor(array: np.ndarray, key: str) -> bytes:
    name = next(name for name, dtype in DTYPES.items() if dtype == array.dtype.newbyteorder("="))
    storage = _tuple(
        _plain("storage"), _global("torch", name), _plain(key), _plain("cpu"), _plain(array.size)
    )
    strides = tuple(math.prod(array.shape[axis + 1 :]) for axis in range(array.ndim))
    view = (_plain(0), _plain(array.shape), _plain(strides), _plain(False), _EMPTY_DICT)
    rebuild = _global("torch._utils", "_rebuild_tensor_v2")
    return rebuild + _tuple(storage + pickle.BINPERSID, *view) + pickle.REDUCE


def _plain(value: str | int | tuple[int, ...]) -> bytes:
    """The operations of a plain value: a pickle without its first operation and its last."""
    return pickle.dumps(value, protocol=2)[2:-1]


def _tuple(*parts: bytes) -> bytes:
    return pickle.MARK + b"".join(parts) + pickle.TUPLE


def _global(module: str, name: str) -> bytes:
    return pickle.GLOBAL + f"{module}\n{name}\n".encode()


_EMPTY_DICT = _global("collections", "OrderedDict") + pickle.EMPTY_TUPLE + pickle.REDUCE


def _little_endian(array: np.ndarray) -> memoryview:
    """The bytes of an array in C order, copied only where they must be."""
    native = np.asarray(array, array.dtype.newbyteorder("="), order="C").reshape(-1)
    bits = native.view(f"=u{native.itemsize}").astype(f"<u{native.itemsize}", copy=False)
    return bits.view(np.uint8).data


def _write(archive: zipfile.ZipFile, name: str, data: bytes | memoryview) -> None:
    # Without a date, so that the same arrays give the same file.
    archive.writestr(zipfile.ZipInfo(f"archive/{name}"), data)
