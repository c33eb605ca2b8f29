"""The synthetic table: what runs, what is said of the rest, and who is ranked."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import jax
import numpy as np
import pytest

from poem_jax.evaluation.systems import Network
from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.experiments.synthetic_table import configs
from poem_jax.models.apply import apply, init
from poem_jax.models.presets import TINY
from poem_jax.synthetic.table_rigs import RING
from poem_jax.tables import synthetic
from poem_jax.tables.all_tables import table_named
from poem_jax.tables.layout import as_markdown, write_table
from poem_jax.tables.picture import curves_of, write_picture
from poem_jax.tables.places import Places
from poem_jax.tables.result import Line, RunSettings
from poem_jax.tables.synthetic import FITTING, MEAN_ROTATED, NOT_FAR_ENOUGH, TRAINED, ranked
from poem_jax.tables.synthetic_models import TABLE_MODELS
from poem_jax.weights.store import save
from tests.evaluation.test_captures import SMALL, Shifted
from tests.tables.conftest import shaken
from tests.tables.numpy_errors import aligned, error_mm

MAKEFILE = Path(__file__).resolve().parents[2] / "Makefile"
SHIFTS = {"v1-0": 4.0, "v1-1": 6.0, "mvp-1": 300.0, "pe-meshtr-0": np.nan}
"""Millimetres by which the stand-ins of trained systems are wrong; one has diverged."""

GONE = "weights gone, scores kept"
LOG_LINE = {"group": "train", "step": 50, "steps_per_second": 50 / 1800, "mpvpe_mm": 80.6}


class ScoredOnce(Shifted):
    """Is not asked again for what it was once asked."""

    asked: ClassVar[set] = set()

    def __call__(self, batch, seen):
        question = (self.shift[0], batch.cameras.K.tobytes(), batch.vertices_world.tobytes())
        assert np.isnan(self.shift[0]) or question not in self.asked
        self.asked.add(question)
        return super().__call__(batch, seen)


class Fit(ScoredOnce):
    settings = "as it is"


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The table, the same made again, and once more where no checkpoint is."""
    places = Places(*(tmp_path_factory.mktemp(name) for name in ("data", "checkpoints", "runs")))
    for name in SHIFTS:
        folder = places.checkpoints / synthetic.FOLDER / name
        folder.mkdir(parents=True)
        (folder / "seal.json").write_text(name)
    log = places.runs / "synthetic_table_v1-1"
    log.mkdir()
    (log / "metrics.jsonl").write_text(json.dumps(LOG_LINE) + "\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "CAPTURES", SMALL)
        patch.setattr(synthetic, "checksum_of_first_stage", lambda params: "the shipped one")
        patch.setattr(synthetic, "load", lambda folder, expected=TINY: (expected, Path(folder)))
        patch.setattr(synthetic, "Network", lambda config, folder: ScoredOnce(SHIFTS[folder.name]))
        patch.setattr(synthetic, "FirstStageFitting", lambda config, folder: Fit(1.0))
        out = str(tmp_path_factory.mktemp("out"))
        settings = RunSettings(out, samples=3, batch_size=3, progress=False)
        elsewhere = replace(places, checkpoints=places.data, runs=places.data)
        return [table_named("synthetic").run(where, settings) for where in (places, places, elsewhere)]


@pytest.fixture(scope="module")
def result(results):
    return results[0]


def test_made_again_it_is_the_same_and_scores_no_model_anew(results):
    first, second, _ = results
    assert ScoredOnce.asked
    assert first == second


def test_without_checkpoints_it_is_made_of_kept_scores_and_says_so(results):
    first, _, without = results
    for line, kept in zip(first.lines, without.lines, strict=True):
        same = {key: words for key, words in kept.what.items() if key != GONE}
        assert (kept.ours, kept.spread, kept.beside, same) == (line.ours, line.spread, line.beside, line.what)
    line = line_of(without, "ring, 8 cameras", "POEM v1")
    assert not line.absent
    assert line.what[GONE] == "0, 1"
    assert first.notes == without.notes[:-1]
    made_again = without.notes[-1]
    for seed in (0, 1):
        command = f"poem train synthetic_table:v1 --train.seed {seed}"
        assert len(re.findall(f"- no checkpoint in .*v1-{seed}: {command}", made_again)) == 1
    (missing,) = line_of(without, "ring, 8 cameras", "MvP").absent
    assert "mvp-0" in missing
    assert line_of(without, "ring, 8 cameras", "MvP").what[GONE] == "1"
    assert "mvp-1" in made_again
    assert "mvp-0" not in made_again


def test_a_model_that_diverged_costs_its_own_line_alone(result):
    line = line_of(result, "ring, 8 cameras", "PE-MeshTR")
    assert line.ours is None
    assert "pe-meshtr-0 could not be scored" in line.absent[0]


def line_of(result, group, label):
    return next(line for line in result.lines if (line.group, line.label) == (group, label))


def test_every_system_stands_in_every_condition(result):
    assert len(result.lines) == len(synthetic.CONDITIONS) * (len(TRAINED) + 3)
    assert {line.group for line in result.lines} == {
        "ring, 8 cameras",
        "ring, the first 4 cameras",
        "ring, the first 2 cameras",
        "ring, 8 cameras, shuffled",
        "front, 5 cameras",
        "corners, 4 cameras",
    }


def test_numbers_are_means_over_frames_and_seeds(result):
    line = line_of(result, "front, 5 cameras", "POEM v1")
    np.testing.assert_allclose(line.ours["mpvpe_mm"], 5.0, rtol=1e-3)
    assert [line.beside[f"MPVPE, seed {seed}"] for seed in (0, 1)] == ["4.00", "6.00"]
    assert line.what["training"] == "1: 50 steps, training MPVPE 81 to 80.6 mm, 0.5 h"
    assert line.samples == 3
    assert not line.absent


def test_what_is_missing_is_said_with_the_command_that_makes_it(result):
    line = line_of(result, "ring, 8 cameras", "POEM v2")
    assert line.ours is None
    assert len(line.absent) == 2
    assert re.search(
        "poem train synthetic_table:v2 --train.seed 1 --train.out .*/synthetic_table_v2-1;", line.absent[1]
    )
    one_seed = line_of(result, "ring, 8 cameras", "MvP")
    assert one_seed.ours is not None
    assert len(one_seed.absent) == 1
    assert "mvp-0" in as_markdown(result)


def test_it_is_written_and_drawn_like_the_papers(result, tmp_path):
    paths = write_table(tmp_path, result)
    assert {Path(path).name for path in paths} == {"synthetic.md", "synthetic.json"}
    rows = json.loads((tmp_path / "synthetic.json").read_text())["rows"]
    (row,) = [row for row in rows if (row["label"], row["data"]) == ("POEM v1", "corners, 4 cameras")]
    assert row["beside"]["paper's rank"] == "1 of 8"
    assert [point.num_views for point in curves_of(result.lines)["POEM v1"]["ours"]] == [2, 4, 8]
    write_picture(tmp_path / "synthetic.png", result)
    assert (tmp_path / "synthetic.png").stat().st_size > 1000


def test_a_system_worse_than_the_turned_mean_hand_has_no_rank(result):
    line = line_of(result, "ring, 8 cameras", "MvP")
    assert line.ours["mpvpe_mm"] > line_of(result, "ring, 8 cameras", MEAN_ROTATED).ours["mpvpe_mm"]
    assert NOT_FAR_ENOUGH in line.notes
    assert line.beside["rank"] == ""
    assert line.beside["paper's rank"] == "8 of 8"


def test_ranks_stand_beside_the_numbers(result):
    _, table = as_markdown(result).split("## ring, 8 cameras\n\n", 1)
    head, _, *rows = table.split("\n\n")[0].splitlines()
    assert head.endswith(
        "| samples | rank | of the paper's systems (in the paper) | paper's rank "
        "| MPVPE, seed 0 | MPVPE, seed 1 |"
    )
    (row,) = [row for row in rows if row.startswith("|  | POEM v1 ")]
    assert row.endswith("| 3 | 1 of 1 | 1 of 1 (1) | 1 of 8 | 4.00 | 6.00 |")


@pytest.mark.slow
def test_a_networks_row_is_numpys(tmp_path, monkeypatch):
    """From the table's own folder of checkpoints, of its own config, by the library's `apply` alone."""
    places = Places(tmp_path, tmp_path / "checkpoints")
    system = next(one for one in TRAINED if one.name == "v2")
    config = TABLE_MODELS["v2"]
    params = shaken(init(config, key=jax.random.key(0)))
    save(system.folder(places, 0), config, params)
    monkeypatch.setattr(synthetic, "CAPTURES", replace(SMALL, image_hw=config.image_hw))
    monkeypatch.setattr(synthetic, "CONDITIONS", (synthetic.Condition(RING, 4),))
    settings = RunSettings(str(tmp_path / "out"), samples=2, batch_size=2, progress=False)
    result = table_named("synthetic").run(places, settings)
    line, fitted = (line_of(result, "ring, the first 4 cameras", label) for label in ("POEM v2", FITTING))
    captures = synthetic.frames_of(RING, 2)
    rows = []
    for one in captures:
        cameras = type(one.cameras)(*(leaf[None, :4] for leaf in one.cameras))
        found = jax.device_get(apply(params, one.views[None, :4], cameras, config=config))
        joints, vertices = found.joints_world[0].astype(float), found.vertices_world[0].astype(float)
        true_joints, truth = one.joints_world.astype(float), one.vertices_world.astype(float)
        rows.append(
            [
                error_mm(vertices, truth),
                error_mm(vertices - joints[0], truth - true_joints[0]),
                error_mm(aligned(vertices, truth), truth),
                error_mm(joints, true_joints),
                error_mm(aligned(joints, true_joints), true_joints),
            ]
        )
    names = ("mpvpe_mm", "rr_mpvpe_mm", "pa_mpvpe_mm", "mpjpe_mm", "pa_mpjpe_mm")
    for name, expected in zip(names, np.mean(rows, axis=0), strict=True):
        assert line.ours[name] == pytest.approx(expected, rel=2e-3), name
    assert 0 < fitted.ours["mpvpe_mm"] < 40


def test_a_folder_that_holds_another_system_is_not_scored(tmp_path):
    places = Places(tmp_path, tmp_path)
    v1, v2 = (next(one for one in TRAINED if one.name == name) for name in ("v1", "v2"))
    config = TABLE_MODELS["v1"]
    save(v2.folder(places, 0), config, init(config, key=jax.random.key(0)))
    assert "checkpoint of another config" in synthetic._opened(places, v2, 0)
    v2.folder(places, 0).rename(v1.folder(places, 0))
    assert isinstance(synthetic._opened(places, v1, 0), Network)


def test_ranks_are_by_error_and_baselines_have_none():
    def line(label, error):
        return Line("rig", label, ("mpvpe_mm",), {}, {"mpvpe_mm": error})

    lines = ranked(
        [
            line(MEAN_ROTATED, 20.0),
            line(FITTING, 1.0),
            line("POEM v1", 9.0),
            line("PE-MeshTR", 8.0),
            line("MvP", 21.0),
            line("v1, G&V-emb", 1.0),
            line("v1, G-emb", 8.5)._replace(ours=None),
        ]
    )
    names = ("rank", "of the paper's systems (in the paper)", "paper's rank")
    ranks = {one.label: tuple(one.beside[name] for name in names) for one in lines}
    assert ranks == {
        MEAN_ROTATED: ("", "", ""),
        FITTING: ("", "", ""),
        "POEM v1": ("3 of 3", "2 of 2 (1)", "1 of 8"),
        "PE-MeshTR": ("2 of 3", "1 of 2 (2)", "4 of 8"),
        "MvP": ("", "", "8 of 8"),
        "v1, G&V-emb": ("1 of 3", "", ""),
        "v1, G-emb": ("", "", ""),
    }


def test_all_are_trained_alike():
    """Data, budget, rates and averages; by the system are its network, losses and which root it is given,
    and whether it has vectors that can begin alike (`test_query_start`)."""

    def common(config):
        return replace(
            config,
            name="",
            model=configs["v2"].model,
            loss=configs["v2"].loss,
            training_root=configs["v2"].training_root,
            train=replace(config.train, out="", smooth_queries=False),
        )

    assert all(common(config) == common(configs["v2"]) for config in configs.values())


def test_table_experiments_and_makefile_name_the_same_systems():
    names = {system.name for system in TRAINED}
    assert names == set(configs)
    listed = re.search(r"^TABLE_SYSTEMS := (.*)$", MAKEFILE.read_text(), re.MULTILINE)
    assert listed is not None
    assert set(listed[1].split()) == names


def test_captures_are_those_of_the_benchmark():
    assert benchmark == synthetic.CAPTURES
    assert not any(config.model.couples_samples for config in configs.values())
    for config in configs.values():
        drawn = config.data.synthetic
        assert replace(drawn, cameras=benchmark.cameras, body=benchmark.body) == benchmark
        assert config.data.seed not in {condition.rig.test_seed for condition in synthetic.CONDITIONS}
