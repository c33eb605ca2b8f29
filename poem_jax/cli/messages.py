"""What a command says: on standard error what it is doing, on standard output what came of it.

Only warnings, errors and the end by a signal carry the prefix `poem:`.
"""

import contextlib
import errno
import logging
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from poem_jax.capture.write import Written

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
"""What the system says where no more can be written."""


def say(text: str) -> None:
    """Tell what the command is doing."""
    print(text, file=sys.stderr, flush=True)


def called_as() -> str:
    """Return the command line of this process, as it can be given again: `poem train ...`, or the script."""
    program, *arguments = sys.argv
    if Path(program).name == "__main__.py":
        # By its path, the file's folder would come first in the search, with modules named as Python's own.
        started = ["python", "-m", "poem_jax.cli"]
    else:
        started = ["python", program] if program.endswith(".py") else [Path(program).name]
    return shlex.join([*started, *arguments])


def set_up_logging() -> None:
    """Show the package's warnings with the prefix `poem:`, and what it is doing without."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Formatter())
    handler.addFilter(_is_not_raised_too)
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    logging.getLogger("poem_jax").setLevel(logging.INFO)


def _is_not_raised_too(record: logging.LogRecord) -> bool:
    """Leave out what Orbax logs of an error, once in every thread that it passes before it reaches us."""
    return not (record.exc_info and "orbax" in Path(record.pathname).parts)


class _Formatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return f"poem: {text}" if record.levelno >= logging.WARNING else text


@contextlib.contextmanager
def tells_what_is_left(out: Path) -> Iterator[None]:
    """When the block is stopped, or the disk is full, say whether anything is in `out` so far."""
    start = time.time()
    try:
        yield
    except (KeyboardInterrupt, OSError) as stop:
        written, full = _written_since(out, start), isinstance(stop, OSError) and stop.errno in DISK_FULL
        if isinstance(stop, KeyboardInterrupt) or (written and full):
            say(f"what was done so far is in {out}" if written else f"nothing was written to {out}")
        raise


def _written_since(out: Path, start: float) -> bool:
    files = [out] if out.is_file() else out.rglob("*")
    # File systems keep whole milliseconds, or less.
    return any(file.is_file() and file.stat().st_mtime >= start - 0.01 for file in files)


def print_files(written: "Written", out: Path) -> None:
    """List the files folder by folder; frames beyond the third in one line."""
    from poem_jax.capture.write import CAPTURE, OVERLAYS

    folders: dict[Path, list[str]] = {}
    for path in written.files:
        folders.setdefault(path.parent, []).append(path.name)
    of_take = [out, *(out / name for name in (OVERLAYS, CAPTURE))]
    frames = [folder for folder in folders if folder not in of_take]
    for folder in frames[:3]:
        print(f"{folder}/  {'  '.join(folders[folder])}")
    if len(frames) > 3:
        print(f"... and {len(frames) - 3} more frames like these")
    for folder in reversed(of_take):
        if folder in folders:
            print(f"{folder}/  {'  '.join(folders[folder])}")


def print_summary(report: dict[str, Any]) -> None:
    """Print how many hands were found, how well they fit, and the time."""
    reprojection = report["reprojection"]
    hands = [hand for frame in report["frames"] for hand in frame.get("hands", [])]
    solved = sum(hand["valid"] for hand in hands)
    print(f"\n{solved} of {len(hands)} hands in {len(report['frames'])} frames", end="")
    print(f", {report['failed_frames']} frames failed" if report["failed_frames"] else "")
    if reprojection["median_px"] is not None:
        print(f"reprojection error {reprojection['median_px']:.1f} px (median, {reprojection['against']})")
    print(f"done in {report['timings_s']['total']:.1f} s")
