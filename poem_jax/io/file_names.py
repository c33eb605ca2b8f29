"""The one rule for names that become files or folders: cameras, frames, hands, from whatever input they come.

A name is one part of a path and never a path, so that nothing is read or written outside the folder it
belongs to. What would be hidden, or another name on another system, is refused as well: a capture can then be
copied to any machine.
"""

import re
import unicodedata
from collections.abc import Sequence

MAX_NAME_BYTES = 200
"""File systems allow 255 bytes; what we write around a name (`overlay_`, `.right.glb`, the ending of a
temporary file) takes up to 55."""
_CONTROL = {"Cc", "Cs", "Zl", "Zp"}
"""Unicode's control characters, halves of surrogate pairs, and breaks of lines and paragraphs."""
_DRIVE = re.compile(r"[A-Za-z]:")


def safe_file_name(name: str, what: str = "a name") -> str:
    """Return the name as it is, or say why it cannot be that of a file or folder.

    Args:
        name: As the user's file gives it.
        what: Begins the message: which name of which file this is.

    Raises:
        ValueError: It is empty, too long, a path, hidden (a leading dot, so also `.` and `..`), begins or
            ends with a space, ends with a dot, or holds control characters or characters UTF-8 cannot write.
    """
    problem = _problem(name)
    if problem:
        raise ValueError(
            f"{what} must also serve as the name of a file or folder; got {_shown(name)}, which {problem}"
        )
    return name


def safe_file_names(names: Sequence[str], what: str = "names") -> tuple[str, ...]:
    """Return names that all serve as names of files in one folder.

    Raises:
        ValueError: As `safe_file_name`, or two are the same name, if written in different forms of Unicode.
    """
    seen: dict[str, int] = {}
    for i, name in enumerate(names):
        key = name_key(safe_file_name(name, f"{what}, number {i},"))
        if key in seen:
            raise ValueError(
                f"{what} must differ from each other; {_shown(name)} is both number {seen[key]} and {i}"
            )
        seen[key] = i
    return tuple(names)


def name_key(name: str) -> str:
    """Return what makes two names the same: an accented letter may be one character or two (macOS)."""
    return unicodedata.normalize("NFC", name)


def _problem(name: str) -> str | None:
    """Say what is wrong with a name, as the end of a sentence; None = nothing."""
    if not name.strip():
        return "is empty"
    bad = next((char for char in name if unicodedata.category(char) in _CONTROL), None)
    if bad is not None:
        return f"holds the control character U+{ord(bad):04X}"
    if "/" in name or "\\" in name or _DRIVE.match(name):
        return "is a path; a name has no `/`, `\\` or drive in it"
    if name.startswith("."):
        return "begins with a dot: it is hidden, or leads out of its folder"
    if name != name.strip() or name.endswith("."):
        return "begins or ends with a space or ends with a dot, which some systems drop"
    size = len(name_key(name).encode())
    if max(size, len(name.encode())) > MAX_NAME_BYTES:
        return f"is too long: {size} bytes in UTF-8, of at most {MAX_NAME_BYTES}"
    return None


def _shown(name: str) -> str:
    """Quote a name without control characters, and a long one in short."""
    quoted = repr(name) if len(name) <= 60 else repr(name[:60]) + "..."
    return quoted.encode("utf-8", "backslashreplace").decode()
