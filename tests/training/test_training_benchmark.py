"""`benchmarks/training.py` comes to an end."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from poem_jax.training.config import BatchShape

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


def test_waiting_is_measured_where_kinds_of_batches_are_alike_or_never_drawn(
    micro_config, micro_batch, monkeypatch
):
    monkeypatch.syspath_prepend(str(FOLDER))
    from training_jobs import jobs  # pyright: ignore[reportMissingImports]

    kinds = (BatchShape(3, 8), BatchShape(3, 8), BatchShape(2, 8, weight=0.0))
    config = replace(micro_config, data=replace(micro_config.data, batches=kinds))

    def draw(step):
        assert step < 20, "two steps should have been counted by now"
        return micro_batch

    monkeypatch.setattr(jobs, "open_experiment", lambda name: config)
    monkeypatch.setattr(jobs, "fresh_state", lambda config, mesh: None)
    monkeypatch.setattr(jobs, "compile_step", lambda config, mesh: lambda state, batch, key: (state, {}))
    monkeypatch.setattr(jobs, "synthetic_batches", lambda data: draw)
    found = jobs.measure_wait("micro", steps=2, thin=False)
    assert 0 <= found["share"] <= 1
    assert found["rate"] > 0


def test_a_failed_process_takes_the_other_with_it(monkeypatch):
    from benchmarks import training

    started = []

    def start(job, devices, options):
        what = "raise SystemExit(3)" if options["index"] == 0 else "import time; time.sleep(600)"
        started.append(subprocess.Popen([sys.executable, "-c", what], stdout=subprocess.PIPE, text=True))
        return started[-1]

    monkeypatch.setattr(training, "_start", start)
    with pytest.raises(SystemExit, match="status 3"):
        training._do_in_processes(name="tiny")
    assert all(process.returncode is not None for process in started)
