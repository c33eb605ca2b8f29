"""Checkpoints of a run: with checksums as soon as they are whole, and never trusted where they are not."""

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.training.checkpoints import Checkpoints
from poem_jax.training.state import TrainState, create_state


@pytest.fixture
def state(micro_params, micro_config) -> TrainState:
    return create_state(micro_params, micro_config)


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


def test_an_empty_run_has_no_checkpoint(micro_config, state):
    with pytest.raises(FileNotFoundError, match="no checkpoint in"):
        restore(micro_config, state)
