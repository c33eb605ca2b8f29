"""What a run says about itself, also after a crash."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from poem_jax.training import journal as journal_module
from poem_jax.training.journal import Journal, forget_after, read_entries


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
    assert [entry["step"] for entry in read_entries(file)] == [2, 4, 6, 4]
    with Journal(tmp_path, micro_config, 4) as journal:
        assert steps(file) == [2, 4, 4]
        journal.write(6, {"loss": 0.5})
    assert steps(file) == [2, 4, 4, 6]
    assert [entry.name for entry in tmp_path.iterdir()] == ["metrics.jsonl"]


@pytest.mark.parametrize("tail", ['{"step": 3, "lo', '{"step": 3}', "3\n", "[]\n", '{"loss": 3}\n', "\n"])
def test_a_broken_tail_goes(tmp_path, tail):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step": 2}\n' + tail)
    assert read_entries(file) == [{"step": 2}]
    forget_after(file, 9)
    assert file.read_text() == '{"step": 2}\n'


def test_a_whole_file_is_left_alone(tmp_path):
    file = tmp_path / "metrics.jsonl"
    forget_after(file, 5)
    assert read_entries(file) == []
    assert not file.exists()
    file.write_text('{"step": 2}\n{"step": 5}\n')
    before = file.stat().st_mtime_ns, file.stat().st_ino
    forget_after(file, 5)
    assert (file.stat().st_mtime_ns, file.stat().st_ino) == before


def test_a_run_that_begins_anew_measures_its_start_anew(tmp_path):
    """A sitting that goes on does not."""
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step": 0}\n{"step": 2}\n')
    forget_after(file, 2)
    assert steps(file) == [0, 2]
    forget_after(file, 0)
    assert steps(file) == []


class Board:
    """Stands for TensorBoard's writer."""

    def __init__(self, folder, purge_step=None):
        self.folder, self.purge_step = Path(folder), purge_step
        self.folder.mkdir(exist_ok=True)
        self.scalars, self.images, self.closed = {}, {}, False

    def add_scalar(self, name, value, step):
        self.scalars[name, step] = value

    def add_image(self, name, picture, step, dataformats):
        assert dataformats == "HWC"
        self.images[name, step] = picture

    def close(self):
        self.closed = True


def test_numbers_and_pictures_arrive_everywhere(micro_config, tmp_path, monkeypatch, capsys):
    boards = []

    def open_board(folder, **options):
        boards.append(Board(folder, **options))
        return boards[-1]

    monkeypatch.setitem(sys.modules, "tensorboardX", SimpleNamespace(SummaryWriter=open_board))
    config = replace(micro_config, train=replace(micro_config.train, tensorboard=True, progress=True))
    picture = np.zeros((4, 6, 3), np.uint8)
    picture[0, 0] = (255, 0, 10)
    with Journal(tmp_path, config, 1) as journal:
        journal.write(2, {"loss": 0.25, "samples_per_second": 12.5, "gradient_norm": 3.0})
        journal.write(2, {"mpvpe_mm_2views": 7.0}, group="validation")
        journal.image(2, "held_out", Path("panels") / "step_2.png", picture)
        journal.advance(3)
    for first_step in (4, 0):
        with Journal(tmp_path, config, first_step):
            pass
    board = boards[0]
    # What TensorBoard has from there on will be sent again.
    assert [board.purge_step for board in boards] == [None, 5, 0]
    assert board.scalars[("train/gradient_norm", 2)] == 3
    assert board.scalars[("validation/mpvpe_mm_2views", 2)] == 7
    np.testing.assert_array_equal(board.images["held_out", 2], picture)
    assert board.closed
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "panels" / "step_2.png"))[..., ::-1], picture)
    bar = capsys.readouterr().err
    assert "4/4" in bar
    assert "loss=0.25, samples/s=12.5" in bar


def test_only_the_first_host_speaks(micro_config, tmp_path, monkeypatch):
    monkeypatch.setattr(journal_module, "is_first_host", lambda: False)
    with Journal(tmp_path / "run", micro_config, 0) as journal:
        journal.write(2, {"loss": 1.0})
        journal.advance()
        journal.image(2, "held_out", Path("a.png"), np.zeros((4, 6, 3), np.uint8))
    assert not (tmp_path / "run").exists()
