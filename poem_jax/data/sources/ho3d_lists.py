"""HO-3D's lists of images, and the frames that its sequences make together; see `ho3d.py`."""

import re
from pathlib import Path
from typing import NamedTuple

VIEW_ORDER = (2, 0, 1, 3, 4)
"""Cameras; the first faces the wall and is the constant master."""
_OF_A_CAMERA = re.compile(r"(.*\d)([0-4])")
"""A main sequence has a number of its own (AP1), and its cameras add a digit to it (AP13): SM1 has one camera
and no digit."""


class Member(NamedTuple):
    """One view of a frame."""

    listed_in: str
    """"train" or "evaluation": the folder, and the list, that hold it."""
    sequence: str
    frame: str
    row: int
    """In the list."""
    place: int
    """Among the list's lines of this sequence."""

    @property
    def main(self) -> str:
        """The sequence without its camera: that of the recording."""
        found = _OF_A_CAMERA.fullmatch(self.sequence)
        return found[1] if found else self.sequence

    @property
    def camera(self) -> int | None:
        """The digit of the camera; None where the recording has but one."""
        found = _OF_A_CAMERA.fullmatch(self.sequence)
        return int(found[2]) if found else None

    @property
    def view_name(self) -> str:
        """The camera's digit, or the sequence where it has none."""
        return self.sequence if self.camera is None else str(self.camera)


def read_list(path: Path) -> list[Member]:
    """Return the members of a list, which is named after their folder, in its order.

    Raises:
        ValueError: It is no text, or a line is not SEQUENCE/FRAME.
    """
    try:
        lines = path.read_text(encoding="utf-8").split()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} must have one SEQUENCE/FRAME per line; it is no text: {error}") from error
    members, places = [], {}
    for row, line in enumerate(lines):
        sequence, slash, frame = line.partition("/")
        if not slash or not (sequence.isalnum() and frame.isdigit()):
            raise ValueError(f"{path} must have one SEQUENCE/FRAME per line; line {row + 1} is {line[:60]!r}")
        places[sequence] = places.get(sequence, -1) + 1
        members.append(Member(path.stem, sequence, frame, row, places[sequence]))
    return members


def group_views(members: list[Member]) -> list[tuple[Member, ...]]:
    """Return frames, by main sequence and number, in first-seen order; each has its views in `VIEW_ORDER`."""
    groups: dict[tuple[str, str], dict[int | None, Member]] = {}
    for member in members:
        groups.setdefault((member.main, member.frame), {})[member.camera] = member
    return [tuple(views[d] for d in (None, *VIEW_ORDER) if d in views) for views in groups.values()]
