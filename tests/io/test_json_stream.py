import json
from pathlib import Path

import pytest

from poem_jax.io import json_stream
from poem_jax.io.json_stream import stream_entries, stream_list

_NESTED = {
    "0": {"17": {"points": [[1.5, -2e-3], [12345678.25, 0]], "name": 'a "b" \\ ] } ü'}, "18": None},
    "1": {},
    "12": {"3": [True, "x"], "4": -7},
}


@pytest.mark.parametrize("chunk", [1, 2, 3, 7, 2**20])
@pytest.mark.parametrize("indent", [None, 2])
def test_entries_are_those_of_the_whole_file_wherever_the_chunks_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int, indent: int | None
):
    monkeypatch.setattr(json_stream, "_CHUNK", chunk)
    path = tmp_path / "a.json"
    path.write_text(json.dumps(_NESTED, indent=indent, ensure_ascii=False), encoding="utf-8")
    expected = [((a, b), value) for a, inner in _NESTED.items() for b, value in inner.items()]
    assert list(stream_entries(path, 2)) == expected
    assert list(stream_entries(path, 1)) == [((key,), value) for key, value in _NESTED.items()]


def test_a_list_is_found_behind_other_keys(tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"first": [1, 2], "info": {"images": 3}, "images": [{"id": 1}, 12, []]}))
    assert list(stream_list(path, "images")) == [{"id": 1}, 12, []]
    with pytest.raises(ValueError, match="must have the key `nothing`"):
        list(stream_list(path, "nothing"))


@pytest.mark.parametrize("chunk", [1, 7, 64, 2**20])
@pytest.mark.parametrize("indent", [None, 1])
def test_a_file_that_is_a_list_is_read_in_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int, indent: int | None
):
    monkeypatch.setattr(json_stream, "_CHUNK", chunk)
    rows = [[i + 0.5, -i * 1e-3] for i in range(100)]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(rows, indent=indent))
    assert list(stream_list(path)) == rows
    path.write_text("[]")
    assert list(stream_list(path)) == []
    path.write_text("[1, 2], 3")
    with pytest.raises(ValueError, match=r"a\.json.*follows the end"):
        list(stream_list(path))


def test_elements_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(json_stream, "_CHUNK", 16)
    path = tmp_path / "a.json"
    path.write_text(json.dumps([[1] * 10, [2] * 1000]))
    elements = stream_list(path, max_value=100)
    assert next(elements) == [1] * 10
    with pytest.raises(ValueError, match="one value takes more than 100 characters"):
        next(elements)
    assert len(list(stream_list(path, max_value=4000))) == 2


def test_numbers_that_are_not_finite_are_read_where_that_is_asked(tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_text("[1, NaN, -Infinity]")
    with pytest.raises(ValueError, match="NaN is no number"):
        list(stream_list(path))
    assert str(list(stream_list(path, allow_nan=True))) == "[1, nan, -inf]"


def test_a_list_is_read_no_further_than_its_end(tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_text('{"images": [1, 2], "annotations": [cut sho')
    assert list(stream_list(path, "images")) == [1, 2]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"a": {"b": [1, 2', "cut short"),
        ('{"a": {"b": 1}', "ends there"),
        ('{"a": {"b": 1} "c": 2}', "expected `,`"),
        ('{"a": [1]}', "expected an object"),
        ('{"a": {"b": NaN}}', "NaN is no number"),
        ('{"a": {"b": 1}} {}', "follows"),
        ("", "expected an object"),
        ('{"a": {1: 2}}', "key must be text"),
    ],
)
def test_what_is_wrong_is_named_with_the_file(tmp_path: Path, text: str, problem: str):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=problem) as raised:
        list(stream_entries(path, 2))
    assert str(path) in str(raised.value)


def test_bytes_that_are_no_text_are_named(tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_bytes(b'{"a": {"b": "\xff\xfe"}}')
    with pytest.raises(ValueError, match=r"a\.json.*not UTF-8"):
        list(stream_entries(path, 2))
    with pytest.raises(FileNotFoundError, match=r"b\.json"):
        list(stream_entries(tmp_path / "b.json", 2))


def test_entries_come_before_the_file_has_been_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(json_stream, "_CHUNK", 2**12)
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"0": {str(i): [0.123456789] * 30 for i in range(500)}})[:-50])
    entries = stream_entries(path, 2)
    for i in range(490):
        assert next(entries)[0] == ("0", str(i))
    with pytest.raises(ValueError, match="cut short"):
        list(entries)
