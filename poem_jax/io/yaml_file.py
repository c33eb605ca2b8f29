"""Read YAML from untrusted files: small ones, plain values alone, and every fault is a `ValueError`."""

from pathlib import Path
from typing import Any

import yaml

MAX_YAML_BYTES = 2**20
"""1 MiB; calibrations of data sets have a few KiB."""
_MAX_DEPTH = 64


def read_yaml(path: str | Path, *, what: str = "YAML file") -> Any:
    """Read one YAML document of plain values (YAML's safe schema).

    Args:
        path: The file, UTF-8 or UTF-16.
        what: What it should be, for the messages.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is too large, no YAML, nests too deeply, or uses anchors, which let a small file stand
            for a huge one.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no {what} at {path}")
    size = path.stat().st_size
    if size > MAX_YAML_BYTES:
        raise ValueError(f"{path} is no {what}: it has {size} bytes, of at most {MAX_YAML_BYTES}")
    return parse_yaml(path.read_bytes(), str(path))


def parse_yaml(text: bytes, source: str, loader: Any = None) -> Any:
    """Parse one YAML document; errors as in `read_yaml`, with `source` as the name of the file.

    Args:
        text: The document.
        source: Its file.
        loader: A safe loader that knows more tags; None = plain values alone.
    """
    try:
        _check_events(text, source)
        return yaml.load(text, loader or _LOADER)
    except (yaml.YAMLError, UnicodeError, RecursionError, ValueError) as error:
        if str(error).startswith(source):
            raise
        raise ValueError(f"{source} cannot be read as YAML: {' '.join(str(error).split())[:300]}") from error


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""libyaml's where PyYAML was built with it: ten times as fast."""


def _check_events(text: bytes, source: str) -> None:
    """Walk over the document before anything is built of it: builders recurse as deep as it nests."""
    depth = 0
    for event in yaml.parse(text, _LOADER):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(
                f"{source} uses YAML aliases (*name), which no data set needs and which are refused"
            )
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _MAX_DEPTH:
            raise ValueError(f"{source} nests too deeply: over {_MAX_DEPTH} lists and maps within each other")
