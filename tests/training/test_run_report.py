"""The report: written however a sitting ends, true, and readable without anything else."""

import json
import logging
import re
import signal
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from poem_jax.io.stopping import Stopped
from poem_jax.training import run_report
from poem_jax.training.journal import Journal
from poem_jax.training.pictures import write_png
from poem_jax.training.run_page import page
from poem_jax.training.run_report import Sitting, reported

SAVED = SimpleNamespace(latest_step=3, best_step=2)


@pytest.fixture
def run(micro_config):
    """A run of 4 steps that has come to step 3, with two validations."""
    folder = Path(micro_config.train.out)
    with Journal(folder, micro_config, 0) as journal:
        for step in (1, 2, 3):
            costs = {"samples_per_second": 9.0, "data_wait_share": 0.031, "peak_memory_mb": 900.0}
            journal.write(step, {"loss": 1.0 / step, "pose": 2.0, "mpvpe_mm": 9.0, **costs})
        journal.write(2, {"mpvpe_mm_2views": 7.0, "mpvpe_mm_8views": 3.0}, group="validation")
        journal.write(3, {"mpvpe_mm_2views": 8.0, "mpvpe_mm_8views": 2.5}, group="validation")
    sitting = Sitting(micro_config, "poem train tiny 'a b'")
    sitting.first_step, sitting.step = 1, 3
    sitting.checkpoints = SAVED
    return sitting


def report(sitting):
    return json.loads((Path(sitting.config.train.out) / "report.json").read_text())


def html(sitting):
    return (Path(sitting.config.train.out) / "report.html").read_text()


@pytest.mark.parametrize(
    ("error", "end"),
    [
        (Stopped(signal.SIGTERM), "stopped by SIGTERM"),
        (KeyboardInterrupt(), "stopped by SIGINT"),
        (FloatingPointError("loss is <nan>"), "failed: FloatingPointError: loss is <nan>"),
        (None, "the time of `train.max_minutes` was over"),
    ],
)
def test_every_end_is_reported(run, error, end):
    if error is None:
        with reported(run):
            pass
    else:
        with pytest.raises(type(error)), reported(run):
            raise error
    found = report(run)
    assert found["end"] == end
    assert (found["step"], found["steps"], found["sitting"]["first_step"]) == (3, 4, 1)
    assert found["to_go_on"] == "poem train tiny 'a b'"
    assert found["checkpoints"] == {"newest": 3, "best": 2}
    assert found["train"]["loss"] == pytest.approx(1 / 3)
    assert found["best"] == {
        "mpvpe_mm_2views": {"value": 7.0, "step": 2},
        "mpvpe_mm_8views": {"value": 2.5, "step": 3},
    }
    assert "<nan>" not in html(run)


def test_a_host_that_another_stopped_says_so(run):
    run.stopped_early = "stopped by another host"
    with reported(run):
        pass
    assert report(run)["end"] == "stopped by another host"


def test_a_finished_run_needs_no_command(run):
    run.step, run.left_out = 4, [1, 2]
    with reported(run):
        pass
    assert report(run)["end"] == "finished"
    assert report(run)["to_go_on"] is None
    assert report(run)["sitting"]["steps_left_out"] == [1, 2]
    assert "poem train" not in html(run)
    assert "the same command again" in Sitting(run.config).how_to_go_on


def test_what_did_not_begin_and_other_hosts_write_nothing(run, monkeypatch):
    with pytest.raises(ValueError, match="another config"), reported(Sitting(run.config)):
        raise ValueError("another config")
    monkeypatch.setattr(run_report, "is_first_host", lambda: False)
    with reported(run):
        pass
    assert not list(Path(run.config.train.out).glob("report*"))


def test_a_report_that_cannot_be_written_hides_no_error(run, caplog):
    caplog.set_level(logging.WARNING)
    (Path(run.config.train.out) / "report.json").mkdir()
    with pytest.raises(FloatingPointError, match="loss"), reported(run):
        raise FloatingPointError("loss")
    assert "the report of the run cannot be written" in caplog.text
    with pytest.raises(IsADirectoryError), reported(run):
        pass


def test_a_page_that_cannot_be_drawn_hides_no_error(run, monkeypatch, caplog):
    def broken(*_):
        raise ZeroDivisionError("an axis")

    monkeypatch.setattr(run_report, "page", broken)
    with pytest.raises(FloatingPointError, match="loss"), reported(run):
        raise FloatingPointError("loss")
    assert "cannot be written: ZeroDivisionError('an axis')" in caplog.text
    assert report(run)["end"] == "failed: FloatingPointError: loss"


def test_numbers_that_are_not_finite_are_null_in_the_report(run):
    line = {"step": 3, "mpvpe_mm_2views": float("nan"), "mpvpe_mm_new": float("inf")}
    with (Path(run.config.train.out) / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"group": "validation"} | line) + "\n")
        file.write(json.dumps({"group": "train", "step": 3, "loss": float("nan")}) + "\n")
    with reported(run):
        pass

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    text = (Path(run.config.train.out) / "report.json").read_text()
    found = json.loads(text, parse_constant=refuse)
    assert found["train"]["loss"] is None
    assert found["validation"]["mpvpe_mm_2views"] is None
    assert found["best"].keys() == {"mpvpe_mm_2views", "mpvpe_mm_8views"}
    assert found["best"]["mpvpe_mm_2views"]["value"] == 7.0


class Page(HTMLParser):
    """Collects what a page draws and refers to; insists that tags are closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.refers, self.words = [], [], [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.refers += [value for name, value in attrs if name in ("src", "href", "srcset")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_the_page_is_whole_and_needs_no_network(run):
    folder = Path(run.config.train.out)
    rng = np.random.default_rng(0)
    write_png(folder / "panels" / "step_0000002.png", rng.integers(0, 255, (8, 8, 3), np.uint8))
    newest = rng.integers(0, 255, (64, 64, 3), np.uint8)
    write_png(folder / "panels" / "step_0000003.png", newest)
    with reported(run):
        pass
    text = html(run)
    shown = Page(text)
    assert [value[:23] for value in shown.refers] == ["data:image/jpeg;base64,"]
    assert "step_0000003.png" in text
    assert not re.search(r"https?://|<script|@import|url\(", text)
    assert 'name="viewport" content="width=device-width' in text
    for title in ("Loss", "Terms of the loss", "Vertex error, held out", "Waiting for data", "Memory"):
        assert title in shown.words
    for label in ("mm, mean", "samples / s", "share of the time", "MB, largest so far", "step"):
        assert label in shown.words
    for legend in ("pose", "mpvpe_mm", "mpvpe_mm_2views"):
        assert legend in shown.words
    assert shown.tags.count("svg") == 7
    assert "3.1%" in shown.words


def test_a_run_without_metrics_and_a_long_one_have_pages(run):
    assert "No metrics" in page("a & b", {"end": "<x>"}, [], None)
    assert "a &amp; b" in page("a & b", {}, [], None)
    long = [{"step": n, "group": "train", "loss": 1.0, "note": "x"} for n in range(50_000)]
    text = page("long", {}, long, None)
    Page(text)
    assert len(text) < 20_000


def test_a_bad_number_costs_its_point_alone(run):
    entries = [{"step": n, "group": "train", "loss": value} for n, value in enumerate([1.0, np.nan, 3.0])]
    assert (
        Page(page("a", {}, [*entries, {"step": 3, "group": "train", "pose": np.nan}], None)).tags.count("svg")
        == 1
    )
