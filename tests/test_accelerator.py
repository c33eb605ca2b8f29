"""What `make accelerator` promises: rows end alone, nothing measured is lost, runs come back from parts."""

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
from tests.accelerator_rows import Ending, Planted
from tools.accelerator import going_on, parts, readme
from tools.accelerator.__main__ import _measure
from tools.accelerator.budget import Budget
from tools.accelerator.captures import drawn_by_processes
from tools.accelerator.flops import count_flops
from tools.accelerator.measurer import Measurer, RowFailed
from tools.accelerator.plan import PLANS, Plan, micro_plan, whole_plan
from tools.accelerator.results import Results
from tools.accelerator.rows import Inference, Machine, Training

ROOT = Path(__file__).resolve().parents[1]
CPU = {
    "device": "cpu",
    "jax": "0",
    "backend": "cpu",
    "peak_tflops": None,
    "float32_product_tflops": 4.0,
    "bfloat16_product_tflops": 10.0,
}


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
    files = parts.pack(folder, tmp_path / "parts", limit=100_000)
    assert len(files) == 4
    assert max(file.stat().st_size for file in files) <= 100_000
    parts.unpack(tmp_path / "parts", tmp_path / "again")
    assert contents(tmp_path / "again") == contents(folder)


def test_packing_anew_leaves_nothing_of_the_parts_before(folder, tmp_path):
    parts.pack(folder, tmp_path / "parts", limit=50_000)
    parts.pack(folder, tmp_path / "parts", limit=200_000)
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
    parts.pack(folder, tmp_path / "parts", limit=100_000)
    fault(tmp_path / "parts" / "001.part")
    with pytest.raises(ValueError, match=words):
        parts.unpack(tmp_path / "parts", tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_a_row_ends_alone_whatever_becomes_of_it():
    with Measurer(on_cpu=True) as measurer:
        first = measurer.measure(Planted(Ending.FINE), 60)["process"]
        with pytest.raises(RowFailed, match=r"^RESOURCE_EXHAUSTED: Out of memory while trying$"):
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


def test_the_plan_asks_for_all_that_the_readme_promises():
    rows = whole_plan().rows
    asked = {(row.precision.value, row.views, row.batch) for row in rows if isinstance(row, Inference)}
    assert asked >= {(p, v, b) for p in ("bfloat16", "float32") for v in (8, 4, 1) for b in (1, 8, 32)}
    assert {row.model_name for row in rows if isinstance(row, Training)} == {"v2-base", "tiny"}
    assert len({row.name for row in rows}) == len(rows)
    # The most valuable first: what has a goal.
    assert {type(row) for row in rows[:3]} == {Inference, Training}
    assert whole_plan().going_on.train.init_from == "shipped"
    assert set(PLANS) == {"whole", "micro"}


def test_the_table_of_a_gpu_is_written_between_the_marks(tmp_path):
    results = Results(tmp_path)
    assert readme.table(results).count("not measured") == 11
    results.use_machine({**CPU, "device": "Planted GPU"})
    common = {"what": "inference", "model": "v2-base", "precision": "bfloat16", "views": 8}
    results.note("a", {**common, "batch": 1, "ms": 4.0, "per_second": 250.0})
    results.note("b", {**common, "batch": 32, "ms": 80.0, "per_second": 400.0})
    results.note("c", {"problem": "failed: no memory"})
    training = {"what": "training", "model": "tiny", "precision": "float32", "batch": 256}
    results.note("d", {**training, "samples_per_second": 1234.0, "tflops": 1.0})
    file = tmp_path / "page.md"
    file.write_text(f"before\n{readme.BEGIN}\nold\n{readme.END}\nafter\n")
    readme.rewrite(file, readme.table(results))
    text = file.read_text()
    assert text.startswith("before\n<!-- accelerator -->\n| Planted GPU, ")
    assert text.endswith("\n<!-- /accelerator -->\nafter\n")
    assert "old" not in text
    assert "best batch | 4.0 ms; 400/s (32) | not measured |" in text
    assert "| not measured | 1234/s at batch 256; 25 % |" in text
    with pytest.raises(ValueError, match="must have the marks"):
        readme.rewrite(tmp_path / "results.json", "")


def test_the_readme_has_the_place_for_the_table(tmp_path):
    file = tmp_path / "README.md"
    file.write_text((ROOT / "README.md").read_text())
    readme.rewrite(file, "new")
    assert "<!-- accelerator -->\nnew\n<!-- /accelerator -->" in file.read_text()


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
