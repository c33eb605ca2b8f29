"""What is wrong with a run is said before it is compiled."""

import importlib.util
from dataclasses import replace

import pytest

from poem_jax.training import loop, preflight
from poem_jax.training.loop import train
from poem_jax.training.preflight import check_before_training


def with_run(config, **options):
    return replace(config, train=replace(config.train, **options))


@pytest.fixture
def without(monkeypatch):
    """Hide a package, whether it is installed or not."""
    find = importlib.util.find_spec

    def hide(name):
        monkeypatch.setattr(importlib.util, "find_spec", lambda asked: None if asked == name else find(asked))

    return hide


@pytest.fixture
def no_work(monkeypatch):
    def work(*_):
        raise AssertionError("the work has begun")

    monkeypatch.setattr(loop, "initial_state", work)
    monkeypatch.setattr(loop, "data_mesh", work)


def test_a_missing_extra_is_named(micro_config, without, no_work):
    without("tensorboardX")
    with pytest.raises(ModuleNotFoundError, match=r"tensorboardX: pip install 'poem-jax\[tensorboard\]'"):
        train(with_run(micro_config, tensorboard=True))
    without("grain")
    with pytest.raises(ModuleNotFoundError, match=r"needs Grain: pip install 'poem-jax\[train\]'"):
        train(micro_config)


def test_a_run_directory_that_cannot_be_written_is_named(micro_config, tmp_path, no_work):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"run cannot be one: .*file is a file; give another --train.out"):
        train(with_run(micro_config, out=str(tmp_path / "file" / "run")))


def test_uncommitted_changes_are_refused_where_asked_for(micro_config, monkeypatch):
    config = with_run(micro_config, require_clean_commit=True)
    for commit in ("0f0f+changes", "unknown"):
        monkeypatch.setattr(preflight, "git_commit", lambda commit=commit: commit)
        with pytest.raises(ValueError, match="uncommitted changes"):
            check_before_training(config)
    monkeypatch.setattr(preflight, "git_commit", lambda: "0f0f")
    check_before_training(config)


def test_a_check_leaves_nothing_behind(micro_config, tmp_path):
    check_before_training(with_run(micro_config, out=str(tmp_path / "a" / "b")))
    assert list(tmp_path.iterdir()) == []
