"""A run in parts of files: whole again elsewhere, and never in the place of a newer one."""

from pathlib import Path

import numpy as np
import pytest

from tools.accelerator import parts
from tools.accelerator.__main__ import _take_the_newer


@pytest.fixture
def folder(tmp_path) -> Path:
    """Files of many bytes that no compression shortens, one of them in a folder below."""
    made, rng = tmp_path / "run", np.random.default_rng(0)
    (made / "checkpoints" / "7").mkdir(parents=True)
    (made / "checkpoints" / "7" / "array").write_bytes(rng.bytes(250_000))
    (made / "metrics.jsonl").write_bytes(rng.bytes(30_000))
    return made


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def test_a_folder_comes_back_from_parts_that_are_small_enough(folder, tmp_path):
    files = parts.pack(folder, tmp_path / "parts", step=7, limit=100_000)
    assert len(files) == 4
    assert max(file.stat().st_size for file in files) <= 100_000
    parts.unpack(tmp_path / "parts", tmp_path / "again")
    assert contents(tmp_path / "again") == contents(folder)


def test_packing_anew_leaves_nothing_of_the_parts_before(folder, tmp_path):
    parts.pack(folder, tmp_path / "parts", step=7, limit=50_000)
    parts.pack(folder, tmp_path / "parts", step=7, limit=200_000)
    assert sorted(f.name for f in (tmp_path / "parts").iterdir()) == ["000.part", "001.part", "parts.json"]
    assert [f.name for f in tmp_path.iterdir() if f.name.startswith(".")] == []


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda part: part.unlink(), "001.part is missing, one of the 3"),
        (lambda part: part.write_bytes(part.read_bytes()[:-1]), "001.part is damaged"),
        (lambda part: part.write_bytes(b"x" + part.read_bytes()[1:]), "001.part is damaged"),
    ],
    ids=["missing", "cut off", "a byte changed"],
)
def test_a_part_that_is_not_as_it_was_is_named_and_nothing_is_written(folder, tmp_path, fault, words):
    parts.pack(folder, tmp_path / "parts", step=7, limit=100_000)
    fault(tmp_path / "parts" / "001.part")
    with pytest.raises(ValueError, match=words):
        parts.unpack(tmp_path / "parts", tmp_path / "again")
    assert not (tmp_path / "again").exists()


def run_at(place: Path, step: int) -> Path:
    (place / "checkpoints" / str(step)).mkdir(parents=True)
    (place / "checkpoints" / str(step) / "array").write_text(str(step))
    return place


@pytest.mark.parametrize(
    ("carried", "here", "taken"),
    [(300, None, 300), (300, 200, 300), (300, 300, 0), (200, 1000, 0)],
    ids=["none here", "an older one here", "as far", "a newer one here"],
)
def test_of_the_run_here_and_the_one_carried_the_newer_goes_on(tmp_path, capsys, carried, here, taken):
    packed = tmp_path / "out" / "parts"
    parts.pack(run_at(tmp_path / "other", carried), packed, step=carried)
    run = tmp_path / "runs" / "mine"
    if here is not None:
        run_at(run, here)
    before = contents(tmp_path / "runs")
    _take_the_newer(run, packed)
    assert ("goes on in" in capsys.readouterr().out) == bool(taken)
    if not taken:
        assert contents(tmp_path / "runs") == before
        return
    assert contents(run) == contents(tmp_path / "other")
    if here is not None:
        assert contents(tmp_path / "runs" / "mine.1") == {f"checkpoints/{here}/array": str(here).encode()}


def test_damaged_parts_leave_the_run_that_stands_there(tmp_path):
    packed, run = tmp_path / "parts", run_at(tmp_path / "mine", 20)
    parts.pack(run_at(tmp_path / "other", 30), packed, step=30)
    (packed / "000.part").write_bytes(b"?")
    with pytest.raises(ValueError, match=r"000\.part is damaged"):
        _take_the_newer(run, packed)
    assert contents(run) == {"checkpoints/20/array": b"20"}
    (packed / "parts.json").write_text('{"parts": []}')
    with pytest.raises(ValueError, match="is not a list of parts: KeyError 'step'"):
        _take_the_newer(run, packed)
