"""Kinds of command-line options that several commands have."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from poem_jax.capture.timing import Timing

Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
File = Annotated[Path, tyro.conf.arg(metavar="FILE")]
OptionalFolder = Annotated[Path | None, tyro.conf.arg(metavar="DIR")]
OptionalFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Detector = Literal["file", "mediapipe-hands", "none"]
"""What found key points: "file" = as their file names it, "none" = take them to be the hand model's."""
Bridge = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
PositionalFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
Experiment = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERIMENT")]
Formats = Annotated[str, tyro.conf.arg(metavar="NAMES")]
"""What `capture.outputs.formats` reads."""


@dataclass(frozen=True)
class Moments:
    """Which moments of a take, and what belongs to them."""

    offsets: str | None = None
    """When cameras began, seconds after the others: cam_1=0.35,cam_2=-1 (or in sync.json); for videos, and
    for folders of images of each camera."""
    start: str | None = None
    """Where to begin: seconds (2.5) or a frame (75f)."""
    end: str | None = None
    """Where to end, likewise."""
    every: int = 1
    """Take each frame of this many."""

    @property
    def are_part(self) -> bool:
        """Whether they are not all."""
        return self.start is not None or self.end is not None or self.every != 1

    def timing(self) -> "Timing":
        """Return them as the capture room takes them; ValueError where one cannot be read."""
        from poem_jax.capture.timing import parse_timing

        return parse_timing(self.offsets, self.start, self.end, self.every)


MomentOptions = Annotated[Moments, tyro.conf.OmitArgPrefixes]
"""Options of several commands, given without a prefix."""
