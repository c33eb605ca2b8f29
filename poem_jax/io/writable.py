"""Whether a result can be written, asked before the work that makes it."""

import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path


def check_folder_is_writable(folder: str | os.PathLike, option: str = "--out") -> None:
    """Insist that files can be written to `folder`, which may be missing; leave nothing behind.

    Raises:
        ValueError: They cannot, since it is a file, say, or the disk is read-only; names the `option` that
            chooses the folder.
    """
    folder = Path(folder)
    try:
        with _made_for_a_moment(folder), tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        existing = next((path for path in (folder, *folder.parents) if _exists(path)), folder)
        reason = f"{existing} is a file" if existing.is_file() else error.strerror
        raise ValueError(
            f"the results go to a folder, and {folder} cannot be one: {reason}; give another {option}"
        ) from error


def check_file_is_writable(file: str | os.PathLike, option: str = "--out") -> None:
    """Insist that `file` can be written or replaced; leave nothing behind, and what is there as it is.

    Raises:
        ValueError: It cannot, since it is a folder, say, or its folder is read-only; names the `option` that
            chooses the file.
    """
    file = Path(file)
    try:
        if file.is_dir():
            raise IsADirectoryError(None, "it is a folder")
        with _made_for_a_moment(file.parent), tempfile.TemporaryFile(dir=file.parent):
            if not file.exists():
                file.touch()
                file.unlink()
    except OSError as error:
        raise ValueError(f"cannot write the file {file}: {error.strerror}; give another {option}") from error


def check_inputs_stay(
    written: Iterable[str | os.PathLike], read: Iterable[str | os.PathLike | None], option: str = "--out"
) -> None:
    """Insist that no file that is to be written is one that is read.

    Args:
        written: Files that will be made or replaced.
        read: The user's files; None = not given.
        option: What chooses where to write.

    Raises:
        ValueError: One is, under this name or another.
    """
    inputs = [Path(path) for path in read if path is not None and _exists(Path(path))]
    for result in (Path(path) for path in written):
        for path in inputs:
            if _exists(result) and result.samefile(path):
                raise ValueError(
                    f"{result} would be replaced by a result, and is read; give another {option}"
                )


@contextlib.contextmanager
def _made_for_a_moment(folder: Path) -> Iterator[None]:
    """Make the folder and those above it, and afterwards remove the ones that were not there."""
    made: list[Path] = []
    try:
        for missing in reversed([path for path in (folder, *folder.parents) if not path.exists()]):
            missing.mkdir()
            made.append(missing)
        yield
    finally:
        for path in reversed(made):
            path.rmdir()


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:
        return False
