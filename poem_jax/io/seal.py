"""A seal on a folder of arrays: size and digest of every file, so that damage is named before it is read.

Readers of large stores fetch many files at once; one that is cut off fails somewhere in the middle of it, in
words of its own. A seal finds the file first.
"""

import hashlib
import json
from pathlib import Path

from poem_jax.io.atomic import whole_file


def write_seal(seal: Path, folder: Path) -> None:
    """Write size and SHA-256 of every file in `folder` to the JSON file `seal`."""
    text = json.dumps(_contents(folder), indent=1, sort_keys=True)
    with whole_file(seal) as file:
        file.write_text(text + "\n", encoding="utf-8")


def check_seal(seal: Path, folder: Path) -> None:
    """Compare a folder with its seal; a folder without one passes.

    Raises:
        ValueError: files are missing, of another size, or changed (all of them are named), or the seal itself
            cannot be read.
    """
    if not seal.is_file():
        return
    try:
        sealed = json.loads(seal.read_text(encoding="utf-8"))
        expected = {name: (entry["bytes"], entry["sha256"]) for name, entry in sealed.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(
            f"{seal} is not a list of files and digests ({type(error).__name__}: {error}). "
            "Remove it to read the folder unchecked"
        ) from error
    found = {name: (entry["bytes"], entry["sha256"]) for name, entry in _contents(folder).items()}
    problems = []
    for name, (size, digest) in sorted(expected.items()):
        if name not in found:
            problems.append(f"{name} is missing")
        elif found[name][0] != size:
            problems.append(f"{name}: expected {size} bytes, got {found[name][0]}")
        elif found[name][1] != digest:
            problems.append(f"{name}: its bytes have changed")
    if problems:
        raise ValueError(
            f"{len(problems)} of {len(expected)} files differ from {seal.name}: {'; '.join(problems[:4])}"
        )


def _contents(folder: Path) -> dict[str, dict[str, int | str]]:
    contents = {}
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            with file.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            contents[file.relative_to(folder).as_posix()] = {"bytes": file.stat().st_size, "sha256": digest}
    return contents
