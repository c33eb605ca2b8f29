"""Checkpoints of a run: with checksums as soon as they are whole, and never trusted where they are not."""

import errno
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orbax.checkpoint import v1 as ocp

from poem_jax.training import checkpoints as checkpoints_module
from poem_jax.training.checkpoint_errors import CheckpointNotWritten, names_failed_write
from poem_jax.training.checkpoints import Checkpoints, export_run
from poem_jax.training.parallel import data_mesh, put_everywhere
from poem_jax.training.state import TrainState


def state_of(size: int) -> TrainState:
    """A state with as many weights, which no two bytes of a file can stand for."""
    weights = jnp.asarray(np.random.default_rng(0).normal(size=size), jnp.float32)
    return TrainState(jnp.zeros((), jnp.int32), {"trainable": {"weights": weights}}, (), None)


@pytest.fixture
def state() -> TrainState:
    return state_of(100)


def at_step(state: TrainState, step: int) -> TrainState:
    return state._replace(step=jnp.asarray(step, jnp.int32))


@pytest.fixture
def run_dir(micro_config, state) -> Path:
    """A run with the checkpoints 2 and 4."""
    with Checkpoints(micro_config.train.out, micro_config) as checkpoints:
        checkpoints.save(at_step(state, 2))
        checkpoints.save(at_step(state, 4), wait=True)
    return Path(micro_config.train.out)


def cut_off(run_dir: Path, step: int) -> None:
    for file in run_dir.glob(f"checkpoints/{step}/state/**/d/*"):
        file.write_bytes(file.read_bytes()[:40])


def restore(config, state, **options) -> TrainState:
    with Checkpoints(config.train.out, config, **options) as checkpoints:
        return checkpoints.restore(state)


def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_it_taken(
    micro_config, state, run_dir, caplog
):
    cut_off(run_dir, 4)
    restored = restore(micro_config, state)
    assert int(restored.step) == 2
    jax.tree.map(np.testing.assert_array_equal, restored.params, state.params)
    assert "checkpoint 4 in" in caplog.text
    assert "damaged" in caplog.text
    assert "got 40" in caplog.text
    assert (run_dir / "damaged" / "4").is_dir()


def test_a_step_is_written_again_where_its_checkpoint_was_damaged(micro_config, state, run_dir, caplog):
    cut_off(run_dir, 4)
    with Checkpoints(run_dir, micro_config) as checkpoints:
        checkpoints.save(at_step(checkpoints.restore(state), 4), wait=True)
    caplog.clear()
    assert int(restore(micro_config, state).step) == 4
    assert "poem_jax" not in {record.name.split(".")[0] for record in caplog.records}


def test_one_without_checksums_is_not_trusted_while_another_has_them(micro_config, state, run_dir, caplog):
    (run_dir / "seals" / "4.json").unlink()
    assert int(restore(micro_config, state).step) == 2
    assert "checkpoint 4 in" in caplog.text
    assert "has no checksums" in caplog.text
    assert (run_dir / "damaged" / "4").is_dir()


def test_without_any_checksums_the_newest_is_taken_but_not_in_silence(micro_config, state, run_dir, caplog):
    shutil.rmtree(run_dir / "seals")
    assert int(restore(micro_config, state).step) == 4
    assert "has no checksums: the run ended while it was written; it is taken unchecked" in caplog.text


def test_opening_a_run_confirms_nothing(micro_config, run_dir):
    (run_dir / "seals" / "4.json").unlink()
    with Checkpoints(run_dir, micro_config):
        pass
    assert [seal.name for seal in (run_dir / "seals").iterdir()] == ["2.json"]


def test_a_reader_sets_nothing_aside(micro_config, state, run_dir, caplog):
    cut_off(run_dir, 4)
    assert int(restore(micro_config, state, read_only=True).step) == 2
    assert "checkpoint 4 in" in caplog.text
    assert (run_dir / "checkpoints" / "4").is_dir()


def test_checksums_follow_the_write_and_go_with_their_checkpoint(micro_config, state, run_dir):
    """A run that is killed later than that has lost nothing."""
    with Checkpoints(run_dir, micro_config) as checkpoints:
        checkpoints.save(at_step(state, 6))
        checkpoints._orbax.wait()
        checkpoints.confirm_write()
        assert sorted(seal.name for seal in (run_dir / "seals").iterdir()) == ["4.json", "6.json"]


def test_when_none_can_be_read_all_are_named(micro_config, state, run_dir):
    cut_off(run_dir, 2)
    cut_off(run_dir, 4)
    with pytest.raises(
        ValueError,
        match=r"checkpoint 4 in .* is damaged .*got 40.*checkpoint 2 in .*Remove that step's folder",
    ):
        restore(micro_config, state)
    assert (run_dir / "checkpoints" / "4").is_dir()


def test_a_whole_checkpoint_that_cannot_be_read_is_no_reason_to_go_back(
    micro_config, state, run_dir, monkeypatch
):
    def fail(*_):
        raise MemoryError("no memory")

    with monkeypatch.context() as patched:
        patched.setattr(ocp.training.Checkpointer, "load", fail)
        with pytest.raises(ValueError, match=r"checkpoint 4 in .* has the files .*no memory.*has been moved"):
            restore(micro_config, state)
    assert not (run_dir / "damaged").exists()
    assert int(restore(micro_config, state).step) == 4


def test_checksums_that_cannot_be_compared_prove_no_damage(micro_config, state, run_dir, monkeypatch):
    def fail(*_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(checkpoints_module, "check_checksums", fail)
    with pytest.raises(ValueError, match=r"checkpoint 4 .* cannot be compared .*Input/output.* been moved"):
        restore(micro_config, state)
    assert not (run_dir / "damaged").exists()


def test_hosts_that_see_other_checkpoints_are_refused(micro_config, run_dir, monkeypatch):
    seen = []
    monkeypatch.setattr(checkpoints_module, "check_same_everywhere", lambda *args: seen.append(args))
    with Checkpoints(run_dir, micro_config):
        assert [text for _, text in seen] == ["4, 2"]


def test_the_first_host_decides_which_have_checksums(micro_config, state, run_dir, monkeypatch):
    """This one's disk still shows those of step 4."""
    monkeypatch.setattr(
        checkpoints_module, "as_on_first_host", lambda own: [step for step in own if step != 4]
    )
    assert int(restore(micro_config, state).step) == 2
    assert (run_dir / "damaged" / "4").is_dir()


def test_a_damaged_best_one_is_not_exported_and_the_way_out_is_said(
    micro_config, state, tmp_path, monkeypatch
):
    monkeypatch.setattr(checkpoints_module, "init", lambda *_, **__: None)
    monkeypatch.setattr(checkpoints_module, "create_state", lambda *_: state)
    config = replace(micro_config, train=replace(micro_config.train, keep_best=True))
    with Checkpoints(config.train.out, config) as checkpoints:
        checkpoints.save(at_step(state, 2), score=1.0)
        checkpoints.save(at_step(state, 4), score=2.0, wait=True)
    cut_off(Path(config.train.out), 2)
    with pytest.raises(ValueError, match=r"the best checkpoint 2 .* is damaged .*--train.no-keep-best exp"):
        export_run(config, tmp_path / "model")


def test_a_failed_write_is_named_where_the_folder_has_gone_too(tmp_path):
    with (
        pytest.raises(CheckpointNotWritten, match="what is free there cannot be told"),
        names_failed_write(2, tmp_path / "gone"),
    ):
        raise OSError("Stale file handle")


def test_an_empty_run_has_no_checkpoint(micro_config, state):
    with pytest.raises(FileNotFoundError, match="no checkpoint in"):
        restore(micro_config, state)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1])


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize("damage", [cut, flip, Path.unlink])
def test_whichever_file_is_damaged_the_run_goes_on_and_writes_that_step_again(
    micro_config, state, run_dir, tmp_path, damage: Callable[[Path], None]
):
    whole = run_dir.rename(tmp_path / "whole")
    files = [file.relative_to(whole) for file in (whole / "checkpoints" / "4").rglob("*") if file.is_file()]
    assert len(files) > 5
    for file in files:
        if not (whole / file).stat().st_size:
            continue
        shutil.copytree(whole, run_dir)
        damage(run_dir / file)
        with Checkpoints(run_dir, micro_config) as checkpoints:
            restored = checkpoints.restore(state)
            assert int(restored.step) == 2, file
            checkpoints.save(at_step(restored, 4), wait=True)
            assert int(checkpoints.restore(state).step) == 4, file
        shutil.rmtree(run_dir)


def test_the_best_is_kept_beside_the_newest(micro_config, state):
    config = replace(micro_config, train=replace(micro_config.train, keep_best=True))
    scores = {1: None, 2: 5.0, 3: 3.0, 4: float("nan"), 5: 3.5, 6: None}
    with Checkpoints(config.train.out, config) as checkpoints:
        assert checkpoints.best_step is None
        for step, score in scores.items():
            checkpoints.save(at_step(state, step), score=score)
        assert checkpoints.steps == [6, 5, 3]
        assert checkpoints.best_step == 3
    with Checkpoints(config.train.out, config) as checkpoints:
        assert checkpoints.best_step == 3
        assert int(checkpoints.read(3, state).step) == 3
        checkpoints.save(at_step(state, 7), score=2.0)
        assert (checkpoints.steps, checkpoints.best_step) == ([7, 6], 7)


def test_scores_of_other_samples_do_not_compare_and_cost_no_checkpoint(micro_config, state, caplog):
    config = replace(micro_config, train=replace(micro_config.train, keep_best=True, keep_checkpoints=1))
    other = replace(config, train=replace(config.train, validation_seed=7))
    with Checkpoints(config.train.out, config) as checkpoints:
        for step, score in ((1, 3.0), (2, 4.0)):
            checkpoints.save(at_step(state, step), score=score)
    assert "do not count" not in caplog.text
    with Checkpoints(config.train.out, other) as checkpoints:
        assert checkpoints.best_step is None
        assert "seed 7; scores of other samples do not count" in caplog.text
        for step, score in ((3, 9.0), (4, 9.5), (5, None)):
            checkpoints.save(at_step(state, step), score=score)
        assert (checkpoints.steps, checkpoints.best_step) == ([5, 3, 1], 3)
    with Checkpoints(config.train.out, config, read_only=True) as checkpoints:
        assert checkpoints.best_step == 3
    with Checkpoints(config.train.out, config) as checkpoints:
        assert checkpoints.best_step == 1


def test_without_keep_best_only_the_newest_are_kept(micro_config, state):
    with Checkpoints(micro_config.train.out, micro_config) as checkpoints:
        for step, score in enumerate((1.0, 2.0, 3.0)):
            checkpoints.save(at_step(state, step), score=score)
        assert (checkpoints.steps, checkpoints.best_step) == ([2, 1], 1)


def test_scores_that_cannot_be_read_close_no_run(micro_config, state, run_dir, caplog):
    (run_dir / "scores.json").write_text("[")
    with Checkpoints(run_dir, micro_config) as checkpoints:
        assert (checkpoints.steps, checkpoints.best_step) == ([4, 2], None)
    assert "scores.json cannot be read" in caplog.text


def test_other_devices_restore_the_same(micro_config, state):
    mine, theirs = (put_everywhere(state, data_mesh(jax.devices()[:count])) for count in (1, 2))
    with Checkpoints(micro_config.train.out, micro_config) as checkpoints:
        checkpoints.save(at_step(mine, 2), wait=True)
        restored = checkpoints.restore(theirs)
    jax.tree.map(np.testing.assert_array_equal, restored.params, state.params)
    assert restored.params["trainable"]["weights"].sharding == theirs.params["trainable"]["weights"].sharding


@contextmanager
def full_disk(most: int = 50_000) -> Iterator[None]:
    """Files cannot grow any more, which is what a full disk looks like to those who write them."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def save_and_train_on(config, state, *, wait: bool) -> None:
    with Checkpoints(config.train.out, config) as checkpoints:
        checkpoints.save(state, wait=wait)
        while True:
            checkpoints.confirm_write()
            time.sleep(0.01)


def test_a_full_disk_is_named_and_costs_no_checkpoint(micro_config, state, run_dir):
    too_much = at_step(state_of(100_000), 6)
    what = r"checkpoint 6 in .* could not be written .*MiB .*free there\). Those before it are as they were"
    for wait in (True, False):
        with full_disk(), pytest.raises(CheckpointNotWritten, match=what):
            save_and_train_on(micro_config, too_much, wait=wait)
    assert not (run_dir / "seals" / "6.json").exists()
    with Checkpoints(run_dir, micro_config) as checkpoints:
        assert checkpoints.steps == [4, 2]
        assert int(checkpoints.restore(state).step) == 4
        checkpoints.save(too_much, wait=True)
