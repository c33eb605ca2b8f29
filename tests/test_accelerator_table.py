"""The rows that are planned, and the table that they fill in README.md."""

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from poem_jax.training.config import Precision
from tests.accelerator_rows import CPU
from tests.precision import coarse_products
from tools.accelerator import inference, readme, training
from tools.accelerator.peaks import peak_tflops
from tools.accelerator.plan import PLANS, whole_plan
from tools.accelerator.results import Results
from tools.accelerator.rows import Fitting, Inference, Training
from tools.accelerator.timing import products_in

ROOT = Path(__file__).resolve().parents[1]


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


def test_every_cell_of_the_table_has_a_row_that_fills_it(tmp_path):
    results = Results(tmp_path)
    results.use_machine(CPU)
    measured = {
        "ms": 1.0,
        "per_second": 1.0,
        "samples_per_second": 1.0,
        "tflops": 1.0,
        "fits_per_second": 1.0,
    }
    for row in whole_plan().rows:
        assert isinstance(row, Inference | Training | Fitting)
        results.note(row.name, row.labels | measured)
    assert "not measured" not in readme.table(results)


def test_the_table_of_a_gpu_is_written_between_the_marks(tmp_path):
    results = Results(tmp_path)
    assert readme.table(results).count("not measured") == 11
    results.use_machine({**CPU, "device": "Planted GPU"})
    common = {"what": "inference", "model": "v2-base", "precision": "bfloat16", "views": 8, "packed": False}
    results.note("a", {**common, "batch": 1, "ms": 4.0, "per_second": 250.0})
    results.note("b", {**common, "batch": 32, "ms": 80.0, "per_second": 400.0})
    results.note("c", {"problem": "failed: no memory"})
    results.note("by infer", {**common, "packed": True, "batch": 64, "ms": 0.1, "per_second": 9000.0})
    training = {"what": "training", "model": "tiny", "batch": 256, "rematerialise": "nothing", "tflops": 1.0}
    results.note("d", {**training, "precision": "float32", "samples_per_second": 1234.0})
    half = {**training, "precision": "bfloat16", "rematerialise": "both"}
    results.note("e", {**half, "samples_per_second": 4321.0})
    file = tmp_path / "page.md"
    file.write_text(f"before\n{readme.BEGIN}\nold\n{readme.END}\nafter\n")
    readme.rewrite(file, readme.table(results))
    text = file.read_text()
    assert text.startswith("before\n<!-- accelerator -->\n| Planted GPU, ")
    assert text.endswith("\n<!-- /accelerator -->\nafter\n")
    assert "old" not in text
    assert "best batch | 4.0 ms; 400/s (32) | not measured |" in text
    assert (
        "| 4321/s at batch 256, rematerialised; 10 % of 10 TFLOP/s of a large product "
        "| 1234/s at batch 256; 20 % of 5 TFLOP/s stated |"
    ) in text
    with pytest.raises(ValueError, match="must have the marks"):
        readme.rewrite(tmp_path / "results.json", "")


def test_the_readme_has_the_place_for_the_table(tmp_path):
    file = tmp_path / "README.md"
    file.write_text((ROOT / "README.md").read_text())
    readme.rewrite(file, "new")
    assert "<!-- accelerator -->\nnew\n<!-- /accelerator -->" in file.read_text()


def test_the_peak_is_that_of_the_device_and_of_the_number_type():
    assert peak_tflops("NVIDIA H100 80GB HBM3") == {"bfloat16": 989.0, "float32": 67.0}
    assert peak_tflops("NVIDIA H100 PCIe") == {"bfloat16": 756.0, "float32": 51.0}
    assert peak_tflops("cpu") == {"bfloat16": None, "float32": None}


def test_rows_in_float32_compute_products_in_float32(monkeypatch):
    """A GPU would take TF32 by default, and the column would not be what it says."""
    a = jnp.zeros((4, 4))
    with products_in(Precision.FLOAT32):
        assert coarse_products(jnp.matmul, a, a) == []
    with products_in(Precision.BFLOAT16):
        assert len(coarse_products(jnp.matmul, a, a)) == 1

    asked = lambda *_, **__: {"asked": jax.config.jax_default_matmul_precision}  # noqa: E731  # pyright: ignore
    monkeypatch.setattr(inference, "measure_inference", asked)
    monkeypatch.setattr(training, "measure_training", asked)
    for row in whole_plan().rows:
        if isinstance(row, Inference | Training):
            assert row.measure()["asked"] == ("highest" if row.precision is Precision.FLOAT32 else None)
