"""The weights that come with the package: as good as promised, and both stages alive."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from poem_jax.cli.evaluate import captures_config
from poem_jax.evaluation.stages import StageErrors, paired_difference, stage_errors
from poem_jax.experiments import open_experiment
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.weights.store import shipped

SEED, SAMPLES, VIEWS = 987654, 64, 4
"""Of the captures, on which no model was trained."""
MAX_MPVPE_MM = 6.45
"""On these captures; 6.26 when it was set. Better weights lower it."""


@pytest.fixture(scope="module")
def captures() -> SyntheticDataset:
    """The distribution on which the shipped model was trained, drawn anew."""
    return SyntheticDataset(captures_config(open_experiment("tiny_synthetic")), seed=SEED)


@pytest.fixture(scope="module")
def errors(captures) -> StageErrors:
    config, params = shipped()
    return stage_errors(params, config, captures, samples=SAMPLES, num_views=VIEWS)


def test_it_is_there_and_of_its_experiment() -> None:
    config, _ = shipped()
    assert config == open_experiment("tiny_synthetic").model


def test_it_has_not_got_worse(errors) -> None:
    print(f"MPVPE {errors.own.mean():.3f} mm")
    assert errors.own.mean() <= MAX_MPVPE_MM


@pytest.mark.parametrize("features", ["zero", "another"])
def test_its_second_stage_reads_the_images(errors, features: str) -> None:
    """On the same captures it is worse by half, at least, without its features, and with those of another
    capture; by 487 and 342 % when this was written.

    Zeros never occur in training, so the second says more. A second stage that ignores its features differs
    by nothing, one that ignores whose they are in the first case alone.
    """
    worse = paired_difference(getattr(errors, features), errors.own)
    print(worse)
    assert worse.mean_mm - 3 * worse.standard_error_mm >= 0.5 * errors.own.mean()


def test_its_second_stage_gains_on_the_first(errors) -> None:
    """A third, at least, on the template posed by the triangulated joints; 38 % when this was written."""
    gain = paired_difference(errors.posed, errors.own)
    print(gain)
    assert gain.mean_mm >= errors.posed.mean() / 3


@pytest.mark.slow
def test_more_views_are_better(tmp_path) -> None:
    """On 200 captures, as the README's table counts them. One view triangulates no joint, so that what it
    gains on the resting template (the mean hand's 58 mm) is the work of the decoder of all points alone.

    By the command, compiled as users' is: compiled as the suite is, it takes six minutes.
    """
    command = [sys.executable, "-m", "poem_jax.cli", "eval", "tiny_synthetic", "--seed", str(SEED)]
    file = tmp_path / "scores.json"
    as_users = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    subprocess.run([*command, "--json", str(file), "--no-progress"], env=as_users, check=True)
    scores = {int(views): row for views, row in json.loads(file.read_text()).items()}
    means = [scores[n]["mpvpe_mm"] for n in (1, 2, 4, 8)]
    print(means)
    assert np.all(np.diff(means) < 0)
    assert means[0] <= 26
    assert means[2] <= MAX_MPVPE_MM + 0.2
    assert means[2] <= scores[4]["mean_pose_mpvpe_mm"] / 7
