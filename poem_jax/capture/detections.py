"""What a detector found in the images of a take: small in memory, and on disk while the search goes on.

Per frame: a byte a view, how many hands it shows (`LOST` = its image could not be read), then a record a
hand. The file begins with one line that says what is searched. It only grows, frame by frame, so that
whatever ends a search leaves all frames before, and a cut last one is dropped.
"""

import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import IO, overload

import numpy as np

from poem_jax.detection import DetectedHand
from poem_jax.geometry.rig import Rig
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.typing import Array, Bool, Float

LOST = 255
"""In place of the number of hands in an image."""
Found = Sequence[Sequence[DetectedHand]]
"""The hands in every view of a frame."""

_HAND = np.dtype(
    [
        ("right", "u1"),
        ("side_score", "<f4"),
        ("score", "<f4"),
        ("keypoints_px", "<f4", (NUM_JOINTS, 2)),
    ]
)
_FIRST_ROOM = 256
_MAX_HEADER_BYTES = 2**16

_log = logging.getLogger(__name__)


class Detections(Sequence[Found]):
    """The hands of the frames so far, one frame appended after the other."""

    def __init__(self, num_views: int) -> None:
        self._num_views = num_views
        self._counts = np.zeros((_FIRST_ROOM, num_views), np.uint8)
        self._starts = np.zeros(_FIRST_ROOM + 1, np.int64)
        """Where the hands of each frame begin, and where the last end."""
        self._hands = np.zeros(_FIRST_ROOM, _HAND)
        self._length = 0

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> Found: ...
    @overload
    def __getitem__(self, index: slice) -> "Detections": ...
    def __getitem__(self, index: "int | slice") -> "Found | Detections":
        """Return the hands of a frame, or the first frames `[:n]`."""
        if isinstance(index, slice):
            return self._first(range(self._length)[index])
        if not -self._length <= index < self._length:
            raise IndexError(index)
        index %= self._length
        counts = [0 if count == LOST else int(count) for count in self._counts[index]]
        ends = self._starts[index] + np.cumsum(counts)
        return [
            [_hand(record) for record in self._hands[end - count : end]]
            for count, end in zip(counts, ends, strict=True)
        ]

    def _first(self, rows: range) -> "Detections":
        assert (rows.start, rows.step) == (0, 1), "only the first frames are ever cut out"
        first = Detections(self._num_views)
        first._counts, first._starts, first._hands = self._counts, self._starts, self._hands
        first._length = len(rows)
        return first

    @property
    def looked_at(self) -> Bool[Array, "frame view"]:
        """Which images could be read."""
        return self._counts[: self._length] != LOST

    @property
    def hands_found(self) -> Array:
        """How many hands each image shows (frame, view)."""
        return np.where(self.looked_at, self._counts[: self._length], 0)

    def append(self, found: Sequence[Sequence[DetectedHand] | None]) -> bytes:
        """Add a frame, None for views without an image; return it as the file holds it."""
        counts = np.array([LOST if hands is None else len(hands) for hands in found], np.uint8)
        records = np.array([_record(hand) for hands in found for hand in hands or ()], _HAND)
        self._add(counts, records)
        return counts.tobytes() + records.tobytes()

    def _add(self, counts: Array, records: Array) -> None:
        start = int(self._starts[self._length])
        end = start + len(records)
        self._counts = _with_room(self._counts, self._length + 1)
        self._starts = _with_room(self._starts, self._length + 2)
        self._hands = _with_room(self._hands, end)
        self._counts[self._length], self._hands[start:end] = counts, records
        self._length += 1
        self._starts[self._length] = end

    def read(self, stream: IO[bytes]) -> int:
        """Take in the whole frames of a file, from where it stands; return where they end."""
        while True:
            end = stream.tell()
            counts = np.frombuffer(stream.read(self._num_views), np.uint8)
            if len(counts) < self._num_views:
                return end
            size = int(counts[counts != LOST].sum()) * _HAND.itemsize
            data = stream.read(size)
            if len(data) < size:
                return end
            self._add(counts, np.frombuffer(data, _HAND))


def within_images(
    keypoints_px: Float[Array, "frame hand view 21 2"], rig: Rig
) -> Float[Array, "frame hand view 21 2"]:
    """Return raw pixels with key points that are guessed beyond the image's border unseen (NaN)."""
    inside = (keypoints_px >= 0) & (keypoints_px <= rig.size_wh[:, None])
    return np.where(inside.all(-1, keepdims=True), keypoints_px, np.nan)


class SearchFile:
    """The file of a search; what it has of the same search is taken up again.

    That of another search is moved aside, to a name with `.old` behind, from where it is taken up as well.
    """

    def __init__(self, path: Path, search: str) -> None:
        """`search`: what is searched and how, in one line."""
        self.path, self._header = path, search.encode() + b"\n"
        self._old = path.with_name(f"{path.name}.old")
        self._stream: IO[bytes] | None = None

    def holds_another_search(self) -> bool:
        """Tell whether there is a file, of other inputs or options, and none of this search."""
        return self.path.is_file() and not self._is_ours(self.path) and not self._is_ours(self._old)

    def take_up(self, num_views: int) -> Detections:
        """Return what was found before, none where there is nothing, and make ready to add to it."""
        found = Detections(num_views)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self._is_ours(self.path):
            self._make_room()
        if self._is_ours(self.path):
            self._stream = self.path.open("r+b")
            self._stream.seek(len(self._header))
            end = found.read(self._stream)
            self._stream.truncate(end)
            self._stream.seek(end)
        else:
            self._stream = self.path.open("wb")
            self._stream.write(self._header)
        return found

    def add(self, frame: bytes) -> None:
        """Add a frame, as `Detections.append` gives it."""
        assert self._stream is not None
        self._stream.write(frame)
        self._stream.flush()

    def close(self) -> None:
        """Leave the file as it is, to be taken up again; one that holds no frame goes."""
        if self._stream is not None:
            is_empty = self._stream.tell() <= len(self._header)
            self._stream.close()
            self._stream = None
            if is_empty:
                os.unlink(self.path)

    def _make_room(self) -> None:
        """Move the file of another search aside, and one of this search that lies there back."""
        returning = self.path.with_name(f"{self.path.name}.new")
        comes_back = self._is_ours(self._old)
        if comes_back:
            os.replace(self._old, returning)
        if _holds_frames(self.path):
            os.replace(self.path, self._old)
            _log.info("%s was of another search, and is kept as %s", self.path, self._old)
        if comes_back:
            os.replace(returning, self.path)

    def _is_ours(self, path: Path) -> bool:
        if not path.is_file():
            return False
        with path.open("rb") as stream:
            return stream.readline(_MAX_HEADER_BYTES) == self._header


def _holds_frames(path: Path) -> bool:
    """Tell whether a file has more than the line that says what is searched."""
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.readline(_MAX_HEADER_BYTES).endswith(b"\n") and stream.read(1) != b""


def _record(hand: DetectedHand) -> tuple:
    return hand.side == "right", hand.side_score, hand.score, hand.keypoints_px


def _hand(record: np.void) -> DetectedHand:
    side = "right" if record["right"] else "left"
    return DetectedHand(record["keypoints_px"], side, float(record["side_score"]), float(record["score"]))


def _with_room(array: Array, length: int) -> Array:
    """Return the array, twice as long where it is shorter than `length`."""
    if len(array) >= length:
        return array
    longer = np.zeros((max(2 * len(array), length), *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer
