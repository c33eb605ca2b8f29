"""Damage a written miniature, one fault at a time, as disks, downloads and strangers do.

Functions that take a path change the file in place. `member` is the name of a file in an archive, `key`
that of a sample in it (what comes before the first dot).
"""

import pickle
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.miniatures.files import save
from poem_jax.miniatures.released_tars import archive, members_of

_JPEG_START, _SCAN_START = b"\xff\xd8", b"\xff\xda"
_ORIENTATION_TAG, _SHORT = 0x0112, 3

# Files of any kind.


def truncate(path: Path, keep: float = 0.6) -> None:
    """Cut a file off, as a download that stopped; `keep` is the share that stays."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def poison(path: Path, marker: Path) -> None:
    """Replace a file by a pickle that, when it is trusted, makes the file `marker`."""
    path.write_bytes(hostile_pickle(marker))


def hostile_pickle(marker: Path) -> bytes:
    """Return a pickle that makes the file `marker` when `pickle.load` runs it."""
    return pickle.dumps(_Hostile(marker))


class _Hostile:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return Path.touch, (self.marker,)


# Pictures.


def flip_header_bit(jpeg: bytes) -> bytes:
    """Return a JPEG whose first marker is wrong by one bit: nothing can decode it."""
    return _flipped(jpeg, 1, 0)


def flip_scan_bit(jpeg: bytes, share: float = 0.5) -> bytes:
    """Return a JPEG with one wrong bit among its compressed pixels, at a share of their length.

    Decoders show a picture that is wrong from there on, often without a word.
    """
    start = jpeg.rindex(_SCAN_START) + 14
    return _flipped(jpeg, start + int((len(jpeg) - start - 4) * share), 3)


def exif_turned(jpeg: bytes, orientation: int = 6) -> bytes:
    """Return a JPEG that asks to be shown turned (6: a quarter to the right), its pixels as they were."""
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, _ORIENTATION_TAG, _SHORT, 1, orientation, 0, 0)
    content = b"Exif\0\0" + tiff
    segment = b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content
    return _JPEG_START + segment + jpeg[2:]


def change_file(path: Path, change: Callable[[bytes], bytes]) -> None:
    """Put what `change` makes of a file's bytes in its place: one of the above, for a raw data set."""
    path.write_bytes(change(path.read_bytes()))


def _flipped(data: bytes, at: int, bit: int) -> bytes:
    return data[:at] + bytes([data[at] ^ (1 << bit)]) + data[at + 1 :]


# Archives.


def empty_archive(path: Path) -> None:
    """Leave an archive without a member."""
    path.write_bytes(archive({}))


def change_member(path: Path, member: str, change: Callable[[bytes], bytes]) -> None:
    """Put what `change` makes of a member's bytes in its place."""
    members = members_of(path)
    members[member] = change(members[member])
    path.write_bytes(archive(members))


def drop_member(path: Path, member: str) -> None:
    """Leave out one file of an archive."""
    members = members_of(path)
    del members[member]
    path.write_bytes(archive(members))


def repeat_key(path: Path, key: str) -> None:
    """Append a sample of an archive to it a second time, under the same key."""
    data = archive({name: of for name, of in members_of(path).items() if name.split(".")[0] == key})
    whole = path.read_bytes()
    path.write_bytes(whole[: _end_of_members(whole)] + data)


def keys_of(path: Path) -> list[str]:
    """Return the keys of an archive's samples, in order."""
    return list(dict.fromkeys(name.split(".")[0] for name in members_of(path)))


def copy_shard(path: Path, number: int) -> Path:
    """Copy an archive to another number of its set, with keys of its own; return its path."""
    copy = path.with_name(f"{path.stem[:-6]}{number:06d}.tar")
    save(copy, archive({f"{number:03d}{name}": data for name, data in members_of(path).items()}))
    return copy


def _end_of_members(tar: bytes) -> int:
    """Return where the zeros begin that end an archive."""
    blocks = np.frombuffer(tar, np.uint8).reshape(-1, 512).any(-1)
    return 512 * (1 + int(np.flatnonzero(blocks)[-1]))


# Labels in archives.


def change_label(path: Path, key: str, change: Callable[[dict[str, Any]], None]) -> None:
    """Let `change` edit the dictionary of a sample's label."""

    def edited(data: bytes) -> bytes:
        label = pickle.loads(data)
        change(label)
        return pickle.dumps(label)

    change_member(path, f"{key}.label.pyd", edited)


def drop_field(path: Path, key: str, field: str) -> None:
    """Leave a field out of a sample's label."""
    change_label(path, key, lambda label: label.pop(field))


def spoil_field(path: Path, key: str, field: str, view: int = 0) -> None:
    """Set the first number of one view's field to NaN."""

    def spoil(label: dict[str, Any]) -> None:
        spoiled = np.array(label[field][view], np.float32)
        spoiled.reshape(-1)[:1] = np.nan
        label[field][view] = spoiled

    change_label(path, key, spoil)


def blow_up_hand(path: Path, key: str, extent_m: float = 3.0) -> None:
    """Make a sample's hand as large as this in every view, about its wrist."""

    def blow_up(label: dict[str, Any]) -> None:
        for joints, vertices in zip(label["joints_3d"], label["verts_3d"], strict=True):
            wrist = joints[0].copy()
            factor = extent_m / np.ptp(vertices, axis=0).max()
            for points in (joints, vertices):
                points[...] = wrist + factor * (points - wrist)

    change_label(path, key, blow_up)


def skew_extrinsic(path: Path, key: str, view: int = 0) -> None:
    """Stretch one camera's extrinsic along x, so that it is no rigid motion."""

    def skew(label: dict[str, Any]) -> None:
        label["cam_extr"][view] = np.diag([1.2, 1, 1, 1]).astype(np.float32) @ label["cam_extr"][view]

    change_label(path, key, skew)


def poison_label(path: Path, key: str, marker: Path) -> None:
    """Replace a sample's label by a pickle that, when it is trusted, makes the file `marker`."""
    change_member(path, f"{key}.label.pyd", lambda _: hostile_pickle(marker))
