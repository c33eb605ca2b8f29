"""Some of the frames of a capture, in any order, without a list of them all."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

from poem_jax.data.capture_folder import FramePaths


@dataclass(frozen=True)
class PickedFrames(Sequence[FramePaths]):
    """The frames in some rows; they are made when they are asked for."""

    frames: Sequence[FramePaths]
    rows: Sequence[int]
    """-1 = a frame without images."""
    names: Sequence[str] = ()
    """By row, where one is -1."""
    num_views: int = 0
    """Likewise."""

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> FramePaths: ...
    @overload
    def __getitem__(self, index: slice) -> "PickedFrames": ...
    def __getitem__(self, index: "int | slice") -> "FramePaths | PickedFrames":
        """Return a frame, or those of a slice."""
        if isinstance(index, slice):
            return PickedFrames(self.frames, self.rows[index], self.names[index], self.num_views)
        row = self.rows[index]
        return FramePaths(self.names[index], (None,) * self.num_views) if row < 0 else self.frames[row]
