"""The committed synthetic table is made of the committed scores, and these of the systems as they stand."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.evaluation.benchmark import DEFAULT_SEED
from poem_jax.evaluation.first_stage_fitting import FirstStageFitting
from poem_jax.experiments.synthetic_table import configs
from poem_jax.hand.template import default_hand
from poem_jax.models.presets import TINY
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.scene import draw_body, prepare_hand
from poem_jax.synthetic.table_rigs import TABLE_RIGS, TEST_FRAMES, captures_of
from poem_jax.synthetic.viewpoints import draw_viewpoints
from poem_jax.tables.kept_scores import Marks, ScoresFile, checksum_of_first_stage, marks_of
from poem_jax.tables.result import RunSettings
from poem_jax.tables.synthetic import (
    CAPTURES,
    CONDITIONS,
    FITTED,
    FITTING,
    KEPT,
    MEAN,
    MEAN_ROTATED,
    NOT_FAR_ENOUGH,
    SEEDS,
    TRAINED,
)
from poem_jax.tables.synthetic_models import TABLE_MODELS
from poem_jax.training.config import differences, flatten_config
from poem_jax.weights.store import shipped

TABLES = Path(__file__).resolve().parents[2] / "docs" / "tables"
FILES = {file.stem: file for file in sorted((TABLES / KEPT).glob("*.npz")) if file.name != FITTED}
BATCH_SIZE = RunSettings().batch_size
TITLES = [condition.title for condition in CONDITIONS]


@pytest.fixture(scope="module")
def first_stage():
    return checksum_of_first_stage(shipped()[1])


@pytest.fixture(scope="module")
def rows():
    rows = json.loads((TABLES / "synthetic.json").read_text())["rows"]
    return {(row["data"], row["label"]): row for row in rows}


def test_there_are_some():
    """At least those of the first sitting."""
    assert {"v2-0", "v2-row-major-0", "v1-0"} <= FILES.keys()
    assert FILES.keys() <= {f"{system.name}-{seed}" for system in TRAINED for seed in SEEDS}


@pytest.mark.parametrize("name", FILES)
def test_scores_are_of_systems_as_they_are_trained_now(name, first_stage):
    system, _, seed = name.rpartition("-")
    kept = ScoresFile(FILES[name], TABLE_MODELS[system], first_stage).read()
    assert kept is not None
    assert kept.config == TABLE_MODELS[system]
    trained = json.loads(kept.training.config)
    assert trained["train.seed"] == int(seed)
    # One run's config and the other's differ in the seed alone.
    assert differences({**trained, "train.seed": 0}, flatten_config(configs[system])) == []
    assert kept.training.summary.startswith(f"{configs[system].train.steps} steps, ")
    assert kept.first_stage == first_stage
    assert set(kept.conditions) == {asked(condition) for condition in CONDITIONS}
    for answer in kept.conditions.values():
        assert all(len(values) == TEST_FRAMES for values in answer.scores.rows.values())


def test_the_table_has_every_row(rows):
    labels = [MEAN, MEAN_ROTATED, FITTING, *(system.label for system in TRAINED)]
    assert set(rows) == {(title, label) for title in TITLES for label in labels}
    assert all(rows[title, label]["ours"] for title in TITLES for label in (MEAN, MEAN_ROTATED, FITTING))


@pytest.mark.parametrize("system", TRAINED, ids=lambda system: system.name)
def test_its_numbers_are_their_means_and_what_is_missing_is_named(rows, system):
    """Recomputed by NumPy from the files alone."""
    there = [seed for seed in SEEDS if f"{system.name}-{seed}" in FILES]
    for condition in CONDITIONS:
        row = rows[condition.title, system.label]
        for seed in set(SEEDS) - set(there):
            assert any(
                f"synthetic_table:{system.name} --train.seed {seed} " in said for said in row["absent"]
            )
        if not there:
            assert row["ours"] is None
            continue
        assert_means(row, [FILES[f"{system.name}-{seed}"] for seed in there], asked(condition))


def asked(condition):
    return condition.in_words(TEST_FRAMES, BATCH_SIZE, DEFAULT_SEED)


def assert_means(row, files, key):
    by_frame = []
    for file in files:
        with np.load(file) as arrays:
            names = json.loads(str(arrays["about"]))["conditions"][key]["metrics"]
            by_frame.append(dict(zip(names, arrays[f"{key}/scores"].astype(float), strict=True)))
    for name, value in row["ours"].items():
        mean = np.mean([one[name] for one in by_frame], axis=0)
        np.testing.assert_allclose(value, mean.mean(), rtol=1e-9)
        spread = mean.std(ddof=1) / np.sqrt(TEST_FRAMES)
        np.testing.assert_allclose(row["standard_error"][name], spread, rtol=1e-9)


def test_the_fit_is_of_the_shipped_first_stage(rows, first_stage):
    kept = ScoresFile(TABLES / KEPT / FITTED, TINY, first_stage).read()
    assert kept is not None
    assert kept.weights == f"{FirstStageFitting(*shipped()).settings}, on {first_stage}"
    for condition in CONDITIONS:
        assert_means(rows[condition.title, FITTING], [TABLES / KEPT / FITTED], asked(condition))


@pytest.mark.parametrize("rig", TABLE_RIGS, ids=lambda rig: rig.name)
def test_scores_are_of_the_captures_that_are_drawn_now(rig, first_stage):
    """Of two frames; and all files' of all frames agree."""
    dataset = SyntheticDataset(captures_of(rig, CAPTURES), seed=rig.test_seed)
    drawn = marks_of([dataset.sample(0)] * 25 + [dataset.sample(25)])
    conditions = [asked(condition) for condition in CONDITIONS if condition.rig is rig]
    files = [ScoresFile(path, TINY, first_stage).read() for path in (*FILES.values(), TABLES / KEPT / FITTED)]
    marks = [file.conditions[condition].captures for file in files for condition in conditions]
    assert Marks(*(leaf[:2] for leaf in marks[0])).agree(drawn)
    assert all(one.agree(marks[0]) for one in marks)


@pytest.mark.slow
@pytest.mark.parametrize("rig", TABLE_RIGS, ids=lambda rig: rig.name)
def test_the_mean_hands_are_numpys(rows, rig):
    """From the hands of all frames, drawn anew without their pictures."""
    config = captures_of(rig, CAPTURES)
    prepared, hands, to_world, to_camera = prepare_hand(default_hand()), [], [], []
    for index in range(TEST_FRAMES):
        scene, cameras = (np.random.default_rng((rig.test_seed, index, stream)) for stream in (0, 1))
        body = draw_body(prepared, config.body, scene)
        joints = body.joints_world.astype(float)
        views = draw_viewpoints(
            config.cameras, config.crop, cameras, joints, config.num_views, config.image_hw
        )
        hands.append(body.vertices_world.astype(float) - joints[9])
        to_world.append(Rotation.from_rotvec(body.pose[0]).as_matrix())
        to_camera.append(views.T_cam_from_world[:, :3, :3])
    V, R, every = np.array(hands), np.array(to_world), np.array(to_camera)

    def error(A):
        mean_hand = np.mean(V @ A, axis=0)
        return 1000 * np.linalg.norm(mean_hand @ np.swapaxes(A, 1, 2) - V, axis=-1).mean()

    for condition in (one for one in CONDITIONS if one.rig is rig):
        first = np.zeros(TEST_FRAMES, int)
        if condition.change is not None:
            first = np.concatenate(
                [first_shuffled(number) for number in range(-(-TEST_FRAMES // BATCH_SIZE))]
            )
        camera = every[np.arange(TEST_FRAMES), first[:TEST_FRAMES]]
        for label, A in ((MEAN, np.swapaxes(camera, 1, 2)), (MEAN_ROTATED, R)):
            assert rows[condition.title, label]["ours"]["mpvpe_mm"] == pytest.approx(error(A), rel=1e-4)


def first_shuffled(number):
    """Which of eight cameras comes first in each sample of a batch."""
    key = jax.random.fold_in(jax.random.key(DEFAULT_SEED), number)
    return np.argmin(np.asarray(jax.random.uniform(key, (BATCH_SIZE, 8))), axis=1)


def test_the_table_of_the_documents_is_the_committed_one(rows):
    """MPVPE and its standard error, to the printed digit."""
    text = (TABLES.parent / "tables.md").read_text().split("**What stands.**")[1]
    printed = {
        cells[0]: cells[1 : 1 + len(TITLES)]
        for line in text.splitlines()
        if line.startswith("| ") and (cells := [cell.strip() for cell in line.strip("|").split("|")])[0]
    }
    labels = {label for title, label in rows if rows[title, label]["ours"]}
    assert labels <= set(printed)
    for label in labels:
        expected = [
            f"{rows[t, label]['ours']['mpvpe_mm']:.1f} ± {rows[t, label]['standard_error']['mpvpe_mm']:.1f}"
            for t in TITLES
        ]
        assert printed[label] == expected, label


@pytest.mark.parametrize("title", TITLES)
def test_ranks_are_by_error_below_the_turned_mean_hand(rows, title):
    bar = rows[title, MEAN_ROTATED]["ours"]["mpvpe_mm"]
    of_systems = {one.label: rows[title, one.label] for one in TRAINED}
    errors = {label: row["ours"]["mpvpe_mm"] for label, row in of_systems.items() if row["ours"]}
    order = sorted(
        (label for label, error in errors.items() if error <= bar), key=lambda label: errors[label]
    )
    for label, row in of_systems.items():
        expected = f"{order.index(label) + 1} of {len(order)}" if label in order else ""
        assert row["beside"]["rank"] == expected
        assert (NOT_FAR_ENOUGH in row["notes"]) == (label in errors and label not in order)
