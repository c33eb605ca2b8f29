"""Files of PyTorch written by hand, operation by operation, so that tests need no torch."""

import io
import pickle
import struct
import zipfile

MAGIC = 0x1950A86A20F9469CFC6C
"""Begins the form that torch wrote before version 1.6."""

# Operations of a pickle, as bytes.


def plain(value) -> bytes:
    return pickle.dumps(value, protocol=2)[2:-1]


def name(module: str, attribute: str) -> bytes:
    return f"c{module}\n{attribute}\n".encode()


def tuple_of(*parts: bytes) -> bytes:
    return b"(" + b"".join(parts) + b"t"


def call(function: bytes, *args: bytes) -> bytes:
    return function + tuple_of(*args) + b"R"


def dict_of(items: dict, start: bytes = b"}") -> bytes:
    return start + b"(" + b"".join(plain(key) + value for key, value in items.items()) + b"u"


def ordered(items: dict) -> bytes:
    """An OrderedDict as `Module.state_dict` makes it: with the attribute `_metadata`."""
    empty = call(name("collections", "OrderedDict"))
    return dict_of(items, empty) + dict_of({"_metadata": dict_of({"": plain({"version": 1})}, empty)}) + b"b"


def storage(form: str, key="0", numel: object = 12, kind: bytes = name("torch", "FloatStorage"), part=None):
    last = [plain(part)] if form == "legacy" else []
    return tuple_of(plain("storage"), kind, plain(key), plain("cpu"), plain(numel), *last) + b"Q"


def tensor(stored: bytes, shape: object = (12,), strides: object = (1,), offset: object = 0) -> bytes:
    view = (
        plain(offset),
        plain(shape),
        plain(strides),
        plain(False),
        call(name("collections", "OrderedDict")),
    )
    return call(name("torch._utils", "_rebuild_tensor_v2"), stored, *view)


# Whole files.


def zip_bytes(
    operations: bytes, storages: dict, order: str | None = "little", root="archive", **options
) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", **options) as archive:
        archive.writestr(f"{root}/data.pkl", b"\x80\x02" + operations + b".")
        if order is not None:
            archive.writestr(f"{root}/byteorder", order)
        for key, array in storages.items():
            archive.writestr(f"{root}/data/{key}", array.tobytes())
        archive.writestr(f"{root}/version", "3\n")
    return stream.getvalue()


def legacy_bytes(operations: bytes, storages: dict) -> bytes:
    facts = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
    before = [pickle.dumps(value, protocol=2) for value in (MAGIC, 1001, facts)]
    keys = pickle.dumps(list(storages), protocol=2)
    numbers = [struct.pack("<q", array.size) + array.tobytes() for array in storages.values()]
    return b"".join([*before, b"\x80\x02" + operations + b".", keys, *numbers])
