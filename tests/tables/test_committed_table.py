"""The committed synthetic table is made of the committed scores, and these of the systems as they stand."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from poem_jax.experiments.synthetic_table import configs
from poem_jax.synthetic.table_rigs import TEST_FRAMES
from poem_jax.tables.kept_scores import KeptModel
from poem_jax.tables.synthetic import CONDITIONS, KEPT, SEEDS, TRAINED
from poem_jax.tables.synthetic_models import TABLE_MODELS

TABLES = Path(__file__).resolve().parents[2] / "docs" / "tables"
FILES = sorted((TABLES / KEPT).glob("*.npz"))
NAMES = {f"{system.name}-{seed}" for system in TRAINED for seed in SEEDS}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_scores_are_of_systems_as_they_are_trained_now(file):
    assert file.stem in NAMES
    name = file.stem.rpartition("-")[0]
    kept = KeptModel(file, TABLE_MODELS[name])
    content = kept.read()
    assert content is not None
    assert content.config == kept.checksum
    assert content.training.startswith(f"{configs[name].train.steps} steps, ")
    assert [re.sub(rf", {TEST_FRAMES} frames.*", "", said) for said in content.conditions] == [
        condition.title for condition in CONDITIONS
    ]


def test_the_table_has_their_means_and_names_what_is_missing():
    """Recomputed by NumPy from the files alone."""
    rows = json.loads((TABLES / "synthetic.json").read_text())["rows"]
    for row in rows:
        system = next((one for one in TRAINED if one.label == row["label"]), None)
        if system is None:
            continue
        files = [file for file in FILES if file.stem in {f"{system.name}-{seed}" for seed in SEEDS}]
        missing = [seed for seed in SEEDS if not any(file.stem == f"{system.name}-{seed}" for file in files)]
        assert all(any(f"--train.seed {seed} " in said for said in row["absent"]) for seed in missing)
        if not files:
            assert row["ours"] is None
            continue
        key = f"{row['data']}, {TEST_FRAMES} frames by 8, seed 0/mpvpe_mm"
        by_frame = np.mean([np.load(file)[key].astype(float) for file in files], axis=0)
        assert len(by_frame) == TEST_FRAMES
        np.testing.assert_allclose(row["ours"]["mpvpe_mm"], by_frame.mean(), rtol=1e-9)
        error = by_frame.std(ddof=1) / np.sqrt(TEST_FRAMES)
        np.testing.assert_allclose(row["standard_error"]["mpvpe_mm"], error, rtol=1e-9)
