"""What a run says about itself, also after a crash."""

import json

import pytest

from poem_jax.training.journal import Journal, forget_after


def steps(file):
    return [json.loads(line)["step"] for line in file.read_text().splitlines()]


def test_a_resumed_run_repeats_no_step(micro_config, tmp_path):
    file = tmp_path / "metrics.jsonl"
    with Journal(tmp_path, micro_config, 0) as journal:
        for step in (2, 4, 6):
            journal.write(step, {"loss": 1.0})
        journal.write(4, {"mpvpe_mm": 2.0}, group="validation")
    with file.open("a") as broken:
        broken.write('{"step": 8, "lo')
    with Journal(tmp_path, micro_config, 4) as journal:
        assert steps(file) == [2, 4, 4]
        journal.write(6, {"loss": 0.5})
    assert steps(file) == [2, 4, 4, 6]
    assert [entry.name for entry in tmp_path.iterdir()] == ["metrics.jsonl"]


@pytest.mark.parametrize("tail", ['{"step": 3, "lo', '{"step": 3}', "3\n", "[]\n", '{"loss": 3}\n', "\n"])
def test_a_broken_tail_goes(tmp_path, tail):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step": 2}\n' + tail)
    forget_after(file, 9)
    assert file.read_text() == '{"step": 2}\n'


def test_a_whole_file_is_left_alone(tmp_path):
    file = tmp_path / "metrics.jsonl"
    forget_after(file, 5)
    assert not file.exists()
    file.write_text('{"step": 2}\n{"step": 5}\n')
    before = file.stat().st_mtime_ns, file.stat().st_ino
    forget_after(file, 5)
    assert (file.stat().st_mtime_ns, file.stat().st_ino) == before
