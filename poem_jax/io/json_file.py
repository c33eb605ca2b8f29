"""Read JSON from untrusted files: whatever is wrong with one ends in a `ValueError` that names it.

Stricter than Python's own reader where that would guess: a key that comes twice, `NaN` and `Infinity`, and
whole numbers beyond 64 bits are errors. More lenient where nothing can be misread: text is UTF-8, UTF-16 or
UTF-32, with or without a byte order mark, as editors on other systems save it.
"""

import json
import math
import os
from pathlib import Path
from typing import Any

MAX_JSON_BYTES = 2**26
"""64 MiB: a rig of a thousand cameras takes a hundredth of it, and reading takes twenty times as much memory
as the file."""
MAX_JSON_DEPTH = 64
"""Lists and objects within each other; ours nest 6 deep."""
_MAX_INTEGER = 2**63


def read_json(path: str | os.PathLike, *, what: str = "JSON file", allow_nan: bool = False) -> Any:
    """Read a JSON file.

    Args:
        path: The file.
        what: What it should be, for the messages.
        allow_nan: Read `NaN` and `Infinity`, which Python writes though JSON has no such numbers; only for
            readers that check every number themselves.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is too large or no JSON, nests too deeply, has a key twice, or a number that is not
            finite or, if whole, beyond 64 bits. The message names file and place.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no {what} at {path}")
    size = path.stat().st_size
    if size > MAX_JSON_BYTES:
        raise ValueError(f"{path} is no {what}: it has {size} bytes, of at most {MAX_JSON_BYTES}")
    return parse_json(path.read_bytes(), str(path), allow_nan=allow_nan)


def parse_json(text: str | bytes, source: str, *, allow_nan: bool = False) -> Any:
    """Parse JSON text; errors as in `read_json`, with `source` as the name of the file."""
    try:
        if isinstance(text, bytes):
            text = text.decode(json.detect_encoding(text))
        content = json.loads(text.removeprefix("\ufeff"), object_pairs_hook=_without_twins)
    except RecursionError:
        raise ValueError(f"{source} nests too deeply to be JSON of ours: over {MAX_JSON_DEPTH}") from None
    except ValueError as error:
        raise ValueError(f"{source} cannot be read as JSON: {error}") from error
    _check_numbers(content, source, allow_nan)
    return content


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key `{twice[:60]}` comes more than once in one object; keep one of them")
    return entries


def _check_numbers(content: Any, source: str, allow_nan: bool) -> None:
    """Walk over all values, without recursion; `place` reads like `cameras[0].K[1]`."""
    waiting: list[tuple[str, int, Any]] = [("", 0, content)]
    while waiting:
        place, depth, value = waiting.pop()
        if isinstance(value, dict):
            waiting += [(f"{place}.{key[:60]}", depth + 1, entry) for key, entry in value.items()]
        elif isinstance(value, list):
            waiting += [(f"{place}[{i}]", depth + 1, entry) for i, entry in enumerate(value)]
        elif isinstance(value, float) and not math.isfinite(value) and not allow_nan:
            raise ValueError(f"{source}: `{place.lstrip('.')}` must be finite; got {value}")
        elif isinstance(value, int) and abs(value) >= _MAX_INTEGER:
            raise ValueError(f"{source}: `{place.lstrip('.')}` is a whole number beyond 64 bits")
        if depth > MAX_JSON_DEPTH:
            raise ValueError(f"{source} nests too deeply to be JSON of ours: over {MAX_JSON_DEPTH}")
