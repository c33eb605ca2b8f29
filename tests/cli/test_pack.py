"""`poem pack`: which source it opens, what it says, and what it asks for."""

import json

import pytest

from poem_jax.cli import USAGE_ERROR, main
from poem_jax.data.sources.released_tars import ReleasedTars
from tests.data.memory_source import MemorySource


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "xla"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def freihand(monkeypatch):
    """The command opens this instead of the real data set; returns how it was called."""
    from poem_jax.data.sources import freihand

    calls = []

    def opened(root, **options):
        calls.append((root, options))
        return MemorySource(3, corrupt=(1,))

    monkeypatch.setattr(freihand, "FreiHAND", opened)
    return calls


def test_pack_writes_shards_that_are_read_and_says_what_it_left_out(tmp_path, capsys, freihand):
    out = tmp_path / "out"
    command = ["pack", "freihand", "--root", str(tmp_path), "--out", str(out), "--split", "test"]
    assert main([*command, "--samples-per-shard", "2"]) == 0
    ((root, options),) = freihand
    assert (root, options["split"], options["mano"]) == (tmp_path, "test", None)
    printed = capsys.readouterr().out
    assert f"2 samples in 2 shards in {out}" in printed
    assert "1 samples were left out; " in printed
    manifest = json.loads((out / "Freihand_mv_test.manifest.json").read_text())
    assert sorted(manifest["shards"]) == ["Freihand_mv_test-000000.tar", "Freihand_mv_test-000001.tar"]
    assert len(ReleasedTars(out)) == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("dexycb",), "dexycb stores poses, from which its vertices are made: give --mano MANO_RIGHT.pkl"),
        (("freihand", "--setup", "s1"), "freihand has no setups; leave --setup out"),
    ],
)
def test_what_is_missing_is_asked_for(tmp_path, capsys, options, words):
    command = ["pack", *options, "--root", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(command) == USAGE_ERROR
    assert words in capsys.readouterr().err


def test_without_a_split_the_papers_is_packed(tmp_path, monkeypatch, freihand):
    from poem_jax.data.sources import oakink

    splits = []
    monkeypatch.setattr(
        oakink, "OakInk", lambda root, **options: splits.append(options["split"]) or MemorySource(1)
    )
    for name in ("oakink", "freihand"):
        assert main(["pack", name, "--root", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert (splits, freihand[0][1]["split"]) == (["train+val"], "train")
    shards = [path.name for path in (tmp_path / "out").glob("*.tar")]
    assert sorted(shards) == ["Freihand_mv_train-000000.tar", "Oakink_mv_train+val-000000.tar"]


def test_check_names_the_shards_that_are_not_what_was_packed(tmp_path, capsys, freihand):
    out = str(tmp_path / "out")
    assert main(["pack", "freihand", "--root", str(tmp_path), "--out", out, "--samples-per-shard", "1"]) == 0
    assert main(["pack", "--check", out]) == 0
    assert "Freihand_mv_train.manifest.json: 2 shards, 2 samples, all as packed" in capsys.readouterr().out
    shards = sorted((tmp_path / "out").glob("*.tar"))
    data = bytearray(shards[0].read_bytes())
    data[-600] ^= 1
    shards[0].write_bytes(data)
    shards[1].unlink()
    assert main(["pack", "--check", out]) == USAGE_ERROR
    said = capsys.readouterr().err
    assert f"{shards[0].name}: its bytes have changed" in said
    assert f"{shards[1].name} is missing" in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--check", "{}"), "no SET_mv_SPLIT.manifest.json in"),
        (("freihand", "--check", "{}"), "--check DIR stands alone"),
        (("freihand", "--root", "{}"), "say what to pack: NAME, --root DIR and --out DIR; or --check DIR"),
    ],
)
def test_what_check_needs_is_said(tmp_path, capsys, options, words):
    assert main(["pack", *(option.format(tmp_path) for option in options)]) == USAGE_ERROR
    assert words in capsys.readouterr().err


def test_a_root_without_the_data_set_is_named(tmp_path, capsys):
    command = ["pack", "freihand", "--root", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(command) == USAGE_ERROR
    assert str(tmp_path) in capsys.readouterr().err
