"""What `poem pack` wrote: for every shard its checksum, its samples, and what was left out of it."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json

_FORMAT = 1


@dataclass(frozen=True)
class ShardEntry:
    """One shard; without samples there is no file."""

    sha256: str
    bytes: int
    samples: int
    keys_sha256: str
    """Of the keys in their order, a line each."""
    skipped: tuple[tuple[int, str], ...] = ()
    """Number of each sample of the source that was left out, and why."""


@dataclass(frozen=True)
class Manifest:
    """All that decides what the shards hold, and the shards that are done."""

    source: str
    fingerprint: Mapping[str, str]
    """Of the source."""
    samples: int
    """Of the source."""
    samples_per_shard: int
    """Of the source; a shard with samples left out has fewer."""
    shards: Mapping[str, ShardEntry] = field(default_factory=dict)
    """By file name."""

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        content = {"format": _FORMAT, **asdict(self)}
        content["shards"] = {name: asdict(self.shards[name]) for name in sorted(self.shards)}
        with whole_file(path) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

    def difference(self, other: "Manifest") -> str | None:
        """Say what the other was made from that this one was not; None: from the same."""
        for name in ("source", "samples", "samples_per_shard"):
            if getattr(self, name) != getattr(other, name):
                return f"`{name}` is {getattr(other, name)!r}, not {getattr(self, name)!r}"
        changed = [
            name
            for name in {**self.fingerprint, **other.fingerprint}
            if self.fingerprint.get(name) != other.fingerprint.get(name)
        ]
        return f"files have changed: {', '.join(changed[:4])}" if changed else None


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or of another version.
    """
    content = read_json(path, what="manifest of packed shards")
    try:
        if content["format"] != _FORMAT:
            raise ValueError(f"its format is {content['format']}, not {_FORMAT}")
        shards = {name: _entry(entry) for name, entry in content["shards"].items()}
        fingerprint = {str(name): str(value) for name, value in content["fingerprint"].items()}
        counts = int(content["samples"]), int(content["samples_per_shard"])
        return Manifest(str(content["source"]), fingerprint, *counts, shards)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is no manifest of packed shards ({type(error).__name__}: {error}); "
            "remove it to pack from the start"
        ) from error


def check_shards(manifest: Manifest, folder: Path) -> list[str]:
    """Return what is wrong with the shards of a manifest, a line each, by their checksums."""
    problems = []
    expected = -(-manifest.samples // manifest.samples_per_shard)
    if len(manifest.shards) < expected:
        problems.append(f"{expected - len(manifest.shards)} of {expected} shards are not packed yet")
    for name, entry in manifest.shards.items():
        path = folder / name
        if not entry.samples:
            continue
        if not path.is_file():
            problems.append(f"{name} is missing")
        elif sha256_of(path) != entry.sha256:
            problems.append(f"{name}: its bytes have changed")
    return problems


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _entry(content: Mapping[str, Any]) -> ShardEntry:
    skipped = tuple((int(number), str(problem)) for number, problem in content["skipped"])
    return ShardEntry(
        str(content["sha256"]),
        int(content["bytes"]),
        int(content["samples"]),
        str(content["keys_sha256"]),
        skipped,
    )
