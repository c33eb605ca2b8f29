"""What `make accelerator` promises: rows end alone, nothing measured is lost, training goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.training.checkpoints import _CHECKSUMS
from poem_jax.training.source import synthetic_batches
from tests.accelerator_rows import CPU, Ending, Planted
from tools.accelerator import going_on, readme
from tools.accelerator.__main__ import _measure
from tools.accelerator.budget import Budget
from tools.accelerator.captures import drawn_by_processes
from tools.accelerator.flops import count_flops
from tools.accelerator.measurer import DoesNotFit, Measurer, RowFailed
from tools.accelerator.plan import Plan, micro_plan, whole_plan
from tools.accelerator.results import Results
from tools.accelerator.rows import Inference, Machine, Training

ROOT = Path(__file__).resolve().parents[1]


def test_a_row_ends_alone_whatever_becomes_of_it():
    with Measurer(on_cpu=True) as measurer:
        first = measurer.measure(Planted(Ending.FINE), 60)["process"]
        with pytest.raises(DoesNotFit, match=r"^RESOURCE_EXHAUSTED: Out of memory while trying$"):
            measurer.measure(Planted(Ending.OUT_OF_MEMORY), 60)
        assert measurer.measure(Planted(Ending.FINE), 60)["process"] == first
        with pytest.raises(RowFailed, match="not finished in 1 s"):
            measurer.measure(Planted(Ending.HANGING), 1)
        with pytest.raises(RowFailed, match="its process ended by SIGABRT"):
            measurer.measure(Planted(Ending.DEATH), 60)


def test_rows_are_kept_one_by_one_and_measured_once(tmp_path):
    """A row that fails or hangs is a line of its own; what has figures is not measured again."""
    plan = Plan(
        Machine(8),
        (Planted(Ending.FINE), Planted(Ending.HANGING), Planted(Ending.OUT_OF_MEMORY, about_s=1e6)),
        micro_plan().going_on,
    )
    results = Results(tmp_path)
    results.use_machine(CPU)

    asked: list[str] = []

    class Scripted:
        def measure(self, row, limit_s):
            asked.append(row.name)
            assert [row.name in stored() for row in plan.rows] == [bool(results.rows), False, False]
            if row.name == "hanging":
                raise RowFailed("not finished in 3 s")
            return {"ms": 1.0}

    def stored() -> dict:
        return json.loads((tmp_path / "results.json").read_text())["rows"]

    _measure(Scripted(), plan, results, Budget(1), keep=30)  # pyright: ignore[reportArgumentType]
    assert asked == ["fine", "hanging"]
    assert stored()["fine"] == {"ms": 1.0}
    assert stored()["hanging"]["problem"] == "failed: not finished in 3 s"
    assert "skipped: it takes about 1000000 s, and 30 s are left" in stored()["out of memory"]["problem"]
    again = Results(tmp_path)
    assert [again.is_measured(row.name) for row in plan.rows] == [True, False, False]
    with pytest.raises(ValueError, match="holds rows of cpu; this is another"):
        again.use_machine({**CPU, "device": "another"})


def test_after_a_batch_that_does_not_fit_half_of_it_comes_at_once(tmp_path):
    """With rematerialisation, where it is training; a row of another problem is left alone."""
    train, infer = (next(r for r in micro_plan().rows if isinstance(r, k)) for k in (Training, Inference))
    plan = Plan(Machine(8), (replace(train, batch=4), infer, Planted(Ending.FINE)), micro_plan().going_on)
    asked: list[str] = []

    class Scripted:
        def measure(self, row, limit_s):
            asked.append(row.name)
            if row.name == infer.name:
                raise RowFailed("another problem")
            if getattr(row, "batch", 1) > 1:
                raise DoesNotFit("out of memory")
            return {"ms": 1.0}

    results = Results(tmp_path)
    _measure(Scripted(), plan, results, Budget(10), keep=0)  # pyright: ignore[reportArgumentType]
    again = [f"training micro bfloat16 batch {batch} rematerialised" for batch in (2, 1)]
    assert asked == ["training micro bfloat16 batch 4", *again, infer.name, "fine"]
    assert [results.is_measured(name) for name in asked] == [False, False, True, False, True]


def test_operations_are_counted_as_on_paper():
    a, b = jnp.zeros((3, 5, 7)), jnp.zeros((3, 7, 11))
    assert count_flops(jax.jit(jnp.matmul), a, b) == 2 * 3 * 5 * 7 * 11
    repeated = lambda a, b: jax.lax.scan(lambda x, _: (x, a @ b), 0.0, None, length=4)[1]  # noqa: E731
    assert count_flops(repeated, a, b) == 4 * 2 * 3 * 5 * 7 * 11
    image, kernel = jnp.zeros((2, 8, 8, 3)), jnp.zeros((3, 3, 3, 16))

    def convolve(image, kernel, stride=1):
        spec = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(image, kernel, (stride, stride), "SAME", dimension_numbers=spec)

    once = 2 * (2 * 8 * 8 * 16) * (3 * 3 * 3)
    assert count_flops(convolve, image, kernel) == once
    gradient = jax.grad(lambda *both: jnp.sum(convolve(*both) ** 2), argnums=(0, 1))
    assert count_flops(gradient, image, kernel) == 3 * once
    strided = jax.grad(lambda *both: jnp.sum(convolve(*both, stride=2) ** 2), argnums=(0, 1))
    assert count_flops(strided, image, kernel) == pytest.approx(3 * once / 4, rel=0.01)


def test_processes_draw_the_batches_of_the_recipe():
    data = replace(micro_plan().going_on.data, seed=5)
    with drawn_by_processes(data, 1) as drawn:
        for step in (0, 3):
            jax.tree.map(np.testing.assert_array_equal, drawn(step), synthetic_batches(data)(step))


@pytest.mark.parametrize(
    ("ending", "code"), [("sys.exit(7)", 7), ("time.sleep(60)", -signal.SIGKILL)], ids=["ends", "goes on"]
)
def test_a_training_whose_time_is_up_may_save_and_is_ended_then(ending, code):
    saves = f"import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: {ending})"
    command = [sys.executable, "-c", f"{saves}; print(flush=True); [time.sleep(1) for _ in range(60)]"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert going_on.stop(process, 1.0) == code


@pytest.mark.parametrize(
    ("code", "asked"), [(0, True), (143, True), (-15, True), (-9, False), (1, False), (130, False)]
)
def test_a_training_that_was_told_to_stop_has_not_failed(code, asked):
    """Nor one whom the signal ends before it listens."""
    assert going_on.ended_as_asked(code) == asked


def test_a_first_sitting_is_soon_on_disk(tmp_path):
    config = whole_plan().going_on
    first = going_on.sitting_of(config, tmp_path, 1.0).train
    assert first.checkpoint_every <= going_on.FIRST_CHECKPOINT < config.train.checkpoint_every
    (tmp_path / "checkpoints" / "20").mkdir(parents=True)
    assert going_on.sitting_of(config, tmp_path, 1.0).train.checkpoint_every == config.train.checkpoint_every


def test_the_last_figures_are_read_around_broken_lines(tmp_path):
    """A run that is killed leaves half a line, and the next sitting one that begins in it."""
    (tmp_path / "metrics.jsonl").write_text(
        '{"step": 2, "group": "train", "loss": 3.0}\n{"step": 4, "gro\n'
        '{"step": 4, "group": "train", "loss": 2.0}\n{"step": 6, "group": "tr'
    )
    assert going_on.figures_of(tmp_path) == {"train": {"step": 4, "loss": 2.0}}


def sitting(tmp_path: Path, until_step: int) -> str:
    """Start the command at its smallest, stop it by a signal once its training has got so far, and return
    what it said; there is more time than it needs."""
    where = [
        "--out",
        str(tmp_path / "out"),
        "--run",
        str(tmp_path / "run"),
        "--readme",
        str(tmp_path / "page.md"),
    ]
    size = ["--device", "cpu", "--size", "micro", "--minutes", "120"]
    with subprocess.Popen(
        [sys.executable, "-m", "tools.accelerator", *size, *where],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as process:
        while (
            process.poll() is None
            and going_on.figures_of(tmp_path / "run").get("train", STEP_0)["step"] < until_step
        ):
            time.sleep(0.2)
        process.send_signal(signal.SIGTERM)
        assert process.stdout is not None
        said = process.stdout.read()
        assert process.wait(600) == 128 + signal.SIGTERM, said
    return said


STEP_0 = {"step": 0}


@pytest.mark.slow
def test_what_is_measured_and_trained_goes_on_elsewhere(tmp_path):
    """Rows once, and the training from the parts alone where its folder is lost."""
    (tmp_path / "page.md").write_text(f"{readme.BEGIN}{readme.END}")
    sitting(tmp_path, until_step=4)
    stored = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [row["problem"] for row in stored["rows"].values() if "problem" in row] == []
    assert "| not measured |" in (tmp_path / "page.md").read_text()
    reached = stored["going_on"]["train"]["step"]
    assert reached >= 4
    (tmp_path / "run").rename(tmp_path / "lost")
    assert list((tmp_path / "lost" / _CHECKSUMS).glob("*.json")), (
        "the last checkpoint was not seen to its end"
    )
    said = sitting(tmp_path, until_step=reached + 2)
    assert said.count("measured before") == len(stored["rows"])
    assert "goes on in" in said
    again = json.loads((tmp_path / "out" / "results.json").read_text())
    assert again["rows"] == stored["rows"]
    assert again["going_on"]["train"]["step"] >= reached + 2
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    steps = [line["step"] for line in map(json.loads, lines) if line["group"] == "train"]
    assert steps == sorted(set(steps))
