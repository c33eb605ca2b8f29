"""JSON files: read however an editor saved them; whatever is wrong with one is named."""

import json
from pathlib import Path

import pytest

from poem_jax.io.json_file import MAX_JSON_BYTES, MAX_JSON_DEPTH, parse_json, read_json

CONTENT = {"unit": "metre", "größe": [1, 2.5, None, True, {"a": "\U0001f590"}]}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_any_unicode_encoding_is_read(encoding, tmp_path: Path):
    file = tmp_path / "a.json"
    file.write_bytes(json.dumps(CONTENT, ensure_ascii=False).encode(encoding))
    assert read_json(file) == CONTENT
    assert parse_json("\ufeff" + json.dumps(CONTENT), "text") == CONTENT


BROKEN = {
    "cut": (b'{"a": 1', r"a\.json cannot be read as JSON: .*line 1"),
    "empty": (b"", "cannot be read as JSON"),
    "binary": (bytes(range(256)), "cannot be read as JSON"),
    "text outside UTF-8": (b'{"a": "\xff"}', "cannot be read as JSON: .*utf-8"),
    "a key twice": (b'{"a": 1, "b": 2, "a": 3}', "the key `a` comes more than once"),
    "a key twice, deep inside": (b'{"c": [{"x": {"K": 1, "K": 2}}]}', "the key `K` comes more than once"),
    "too deep for Python": (b"[" * 10**5 + b"]" * 10**5, "nests too deeply"),
    "too deep for us": (b"[" * 100 + b"]" * 100, f"nests too deeply .*over {MAX_JSON_DEPTH}"),
    "NaN": (b'{"c": [{"t": [0, NaN]}]}', r"a\.json: `c\[0\]\.t\[1\]` must be finite; got nan"),
    "Infinity": (b'{"t": -Infinity}', "`t` must be finite; got -inf"),
    "a float too large": (b'{"t": 1e999}', "`t` must be finite; got inf"),
    "an integer too large": (b'{"n": [' + b"9" * 400 + b"]}", r"`n\[0\]` is a whole number beyond 64 bits"),
    "an integer too long": (b'{"n": ' + b"9" * 10000 + b"}", "cannot be read as JSON"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_wrong_is_named(case, tmp_path: Path):
    content, message = BROKEN[case]
    file = tmp_path / "a.json"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_json(file)


def test_size_and_presence(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="no rig at"):
        read_json(tmp_path / "none.json", what="rig")
    with pytest.raises(FileNotFoundError, match="no rig at"):
        read_json(tmp_path, what="rig")
    with (tmp_path / "big.json").open("wb") as stream:
        stream.truncate(MAX_JSON_BYTES + 1)
    with pytest.raises(ValueError, match=r"big\.json is no rig: it has \d+ bytes"):
        read_json(tmp_path / "big.json", what="rig")


def test_a_reader_that_checks_its_numbers_may_have_nan():
    assert str(parse_json("[NaN, 1e999]", "text", allow_nan=True)) == "[nan, inf]"
