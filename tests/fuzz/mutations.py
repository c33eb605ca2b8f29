"""Damage for files: bytes flipped, cut and inserted anywhere, and inside what a checksum would protect.

A byte changed in an archive or a PNG fails at a checksum, before the parser behind it is reached. So archives
are also packed anew around a damaged member, PNGs around a damaged chunk, and JSON around a wrong value.
"""

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

Mutation = Callable[[np.random.Generator, bytes], bytes]

_LONGEST_RUN = 32
"""Bytes within a longer run of equal ones are numbers, not structure: these are hit seldom."""
_EDGES = (b"\0", b"\xff", b"\x7f", b"\x80", bytes(4), b"\xff" * 4, b"\xff\xff\xff\x7f", b"\1" + bytes(7))
_VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 0.5, 1e308, 1e-320, 10**18, 10**400, float("nan"), float("-inf"), "", "a\0", "../x",
    ".", "1e5", "\ud800", "é" * 150, "x" * 10**5, [], {}, [[]], [0] * 1000, [[0, 0, 0]] * 3, [None] * 3,
    {"a": {"a": {}}},
)  # fmt: skip


def damage_bytes(rng: np.random.Generator, data: bytes) -> bytes:
    """Do one to four times: flip a bit, set bytes, cut, delete, insert or repeat a piece."""
    places = _structure(data)
    for _ in range(rng.integers(1, 5)):
        start = int(places[rng.integers(len(places))]) if rng.random() < 0.9 and len(places) else 0
        start = min(start, len(data))
        stop = min(len(data), start + int(rng.integers(1, 20)))
        piece = data[start:stop]
        match rng.integers(7):
            case 0 if piece:
                data = data[:start] + bytes([piece[0] ^ (1 << rng.integers(8))]) + data[start + 1 :]
            case 1:
                data = data[:start] + rng.bytes(stop - start) + data[stop:]
            case 2:
                edge = _EDGES[rng.integers(len(_EDGES))]
                data = data[:start] + edge + data[start + len(edge) :]
            case 3 if rng.random() < 0.3:
                data = data[:start]
            case 4:
                data = data[:start] + data[stop:]
            case 5:
                data = data[:start] + rng.bytes(int(rng.integers(1, 9))) + data[start:]
            case _:
                data = data[:start] + piece * int(rng.integers(2, 5)) + data[stop:]
    return data


def damage_archive(rng: np.random.Generator, data: bytes) -> bytes:
    """Damage a zip file as bytes, or one member of it, its name or its presence, and pack it anew."""
    if rng.random() < 0.3:
        return damage_bytes(rng, data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(entry.filename, entry.compress_type, archive.read(entry)) for entry in archive.infolist()]
    index = int(rng.integers(len(members)))
    name, method, content = members[index]
    chance = rng.random()
    if chance < 0.8:
        content = damage_bytes(rng, content)
    elif chance < 0.9:
        name = name[: rng.integers(len(name))] + "x"
    else:
        content = members[rng.integers(len(members))][2]
    members[index] = (name, method, content)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for entry, method, content in members:
            archive.writestr(zipfile.ZipInfo(entry), content, method)
    return stream.getvalue()


def damage_png(rng: np.random.Generator, data: bytes) -> bytes:
    """Damage a PNG as bytes, or the contents of one chunk, with the right length and checksum."""
    if rng.random() < 0.3:
        return damage_bytes(rng, data)
    chunks, position = [], 8
    while position < len(data):
        (length,) = struct.unpack_from(">I", data, position)
        chunks.append((data[position + 4 : position + 8], data[position + 8 : position + 8 + length]))
        position += 12 + length
    index = int(rng.integers(len(chunks)))
    kind, content = chunks[index]
    chunks[index] = (kind, damage_bytes(rng, content))
    packed = (
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in chunks
    )
    return data[:8] + b"".join(packed)


def damage_json(rng: np.random.Generator, data: bytes) -> bytes:
    """Damage JSON as bytes, or put a wrong value in the place of one, leave one out or add one."""
    if rng.random() < 0.3:
        return damage_bytes(rng, data)
    content = json.loads(data)
    place = content
    while True:
        keys = list(place) if isinstance(place, dict) else range(len(place))
        if not keys:
            break
        key = keys[int(rng.integers(len(keys)))]
        if isinstance(place[key], dict | list) and rng.random() < 0.8:
            place = place[key]
            continue
        match rng.integers(6):
            case 0:
                del place[key]
            case 1 if isinstance(place, dict):
                place["more" if rng.random() < 0.5 else key * 2] = place[key]
            case _:
                place[key] = _VALUES[rng.integers(len(_VALUES))]
        break
    return json.dumps(content).encode()


def _structure(data: bytes) -> np.ndarray:
    """Positions of bytes that do not lie within a long run of equal ones."""
    values = np.frombuffer(data, np.uint8)
    edges = np.flatnonzero(np.diff(values)) + 1
    bounds = np.concatenate([[0], edges, [len(values)]])
    lengths = np.repeat(np.diff(bounds), np.diff(bounds))
    return np.flatnonzero(lengths < _LONGEST_RUN)
