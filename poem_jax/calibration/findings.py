"""What was found wrong with a calibration or its key points, in words."""

from typing import NamedTuple


class Finding(NamedTuple):
    """One fault: what it is, how one can tell, and what to do."""

    name: str
    """Short and stable, for programs: `inverted extrinsics`, `joint order`, `cameras exchanged`."""
    evidence: str
    """What was seen, with its figures: a sentence without a full stop."""
    fix: str
    """What the user is to do: an imperative without a full stop."""
    fatal: bool = True
    """Whether nothing right can come of it; else most of the cameras or the frames serve, and it is a
    warning."""

    def __str__(self) -> str:
        """Return evidence and fix as one line."""
        return f"{self.evidence}; {self.fix}"
