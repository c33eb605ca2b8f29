"""Size and digest of every file in a folder, so that damage is named before the folder is read.

Readers of large stores fetch many files at once; one that is cut off fails somewhere in the middle of it, in
words of its own. Checksums find the file first.
"""

import hashlib
import json
import logging
from pathlib import Path

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json

_log = logging.getLogger(__name__)


def write_checksums(file: Path, folder: Path) -> None:
    """Write size and SHA-256 of every file in `folder` to the JSON file `file`, which is not among them."""
    text = json.dumps(_contents(folder), indent=1, sort_keys=True)
    with whole_file(file) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def check_checksums(file: Path, folder: Path) -> None:
    """Compare a folder with its checksums; where these are missing, a warning says that it is read unchecked.

    Files beside those listed do not count: file managers leave some.

    Raises:
        ValueError: files are missing, of another size or changed (four of them are named), or the checksums
            themselves cannot be read.
    """
    if not file.is_file():
        _log.warning("%s is read unchecked: %s is missing, so damage may go unnoticed", folder, file.name)
        return
    expected = _read(file)
    found = {name: (entry["bytes"], entry["sha256"]) for name, entry in _contents(folder).items()}
    problems = []
    for name, (size, digest) in sorted(expected.items()):
        if name not in found:
            problems.append(f"{name[:200]} is missing")
        elif found[name][0] != size:
            problems.append(f"{name}: expected {size} bytes, got {found[name][0]}")
        elif found[name][1] != digest:
            problems.append(f"{name}: its bytes have changed")
    if problems:
        raise ValueError(
            f"{len(problems)} of {len(expected)} files differ from {file.name}: {'; '.join(problems[:4])}"
        )


def _read(file: Path) -> dict[str, tuple[int, str]]:
    try:
        entries = read_json(file).items()
        return {name: (int(entry["bytes"]), str(entry["sha256"])) for name, entry in entries}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(
            f"{file} is not a list of files and digests ({type(error).__name__}: {error}). "
            "Remove it to read the folder unchecked"
        ) from error


def _contents(folder: Path) -> dict[str, dict[str, int | str]]:
    contents = {}
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            with file.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            contents[file.relative_to(folder).as_posix()] = {"bytes": file.stat().st_size, "sha256": digest}
    return contents
