"""Tables from end to end on miniatures; one row of each recomputed with NumPy from what the model finds."""

import json
import zipfile
from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.data.augmentation import augment
from poem_jax.data.augmentation_recipes import NONE
from poem_jax.data.sources.ho3d import HO3D
from poem_jax.data.sources.released_tars import ReleasedTars
from poem_jax.experiments import v1_paper
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import OPENPOSE_FROM_MANO, ROOT_JOINT, TIP_VERTICES_REGRESSED
from poem_jax.models.apply import apply
from poem_jax.models.frustum_config import CUBOIDS
from poem_jax.models.presets import PRESETS, released
from poem_jax.tables import run as run_module
from poem_jax.tables.all_tables import TABLES, table_named
from poem_jax.tables.models import v1, v2
from poem_jax.tables.places import Places
from poem_jax.tables.result import Line, RunSettings, TableResult
from poem_jax.tables.row import Checkpoint, Quoted, Shipped
from poem_jax.tables.same_system import is_of_preset
from poem_jax.tables.table import Table
from poem_jax.weights.store import load
from tests.tables.conftest import write_small
from tests.tables.numpy_errors import aligned, area, error_mm, f_score

QUIET = RunSettings(batch_size=1, progress=False)


_apply = jax.jit(apply, static_argnames="config")
"""Compiled like the system's own, so that the tests' cache of programs serves both."""


def run(name: str, places: Places, settings: RunSettings = QUIET) -> TableResult:
    return table_named(name).run(places, settings)


def line_of(result: TableResult, group: str, label: str) -> Line:
    (line,) = [line for line in result.lines if (line.group, line.label) == (group, label)]
    return line


def found_by(folder, frame, views, root_world=None):
    """What a checkpoint finds in views of a frame: joints, vertices (first view's frame), and its hand."""
    config, params = load(folder)
    sample = augment(frame, np.array(views), NONE, config.image_hw, np.random.default_rng(0))
    root = np.full(3, np.nan) if root_world is None else root_world
    given = {"root_world": np.asarray(root, np.float32)[None]} if config.takes_root else {}
    cameras = type(sample.cameras)(*(leaf[None] for leaf in sample.cameras))
    pred = _apply(params, sample.views[None], cameras, config=config, **given)
    hand = HandModel(**jax.device_get(params["constants"]["hand"]))
    return np.asarray(pred.joints_world[0], float), np.asarray(pred.vertices_world[0], float), hand


def regressed(hand: HandModel, vertices: np.ndarray) -> np.ndarray:
    """Joints of a mesh: MANO's order and the tips, then OpenPose's order."""
    both = np.concatenate([hand.J_regressor.astype(float) @ vertices, vertices[list(TIP_VERTICES_REGRESSED)]])
    return both[list(OPENPOSE_FROM_MANO)]


def check_as_poem(line: Line, folder, frame, views) -> None:
    """Compare a row of POEM's own, of one frame, with NumPy: joints regressed from the meshes."""
    check_row(line, found_by(folder, frame, views), frame, views[0], from_mesh=True)


def check_row(line: Line, found, frame, first: int, *, from_mesh: bool) -> None:
    joints, vertices, hand = found
    truth, true_joints = frame.vertices_cam[first].astype(float), frame.joints_cam[first].astype(float)
    ours, theirs = joints, true_joints
    if from_mesh:
        ours, theirs = regressed(hand, vertices), regressed(hand, truth)
    expected = {
        "mpvpe_mm": error_mm(vertices, truth),
        "rr_mpvpe_mm": error_mm(vertices - ours[0], truth - theirs[0]),
        "pa_mpvpe_mm": error_mm(aligned(vertices, truth), truth),
        "auc_v_20": area(vertices, truth, 20, 20),
        "mpjpe_mm": error_mm(ours, theirs),
        "rr_mpjpe_mm": error_mm(ours - ours[0], theirs - theirs[0]),
        "pa_mpjpe_mm": error_mm(aligned(ours, theirs), theirs),
        "auc_j_20": area(joints, true_joints, 20, 20),
        "auc_v_50": area(vertices, truth, 50, 20),
        "auc_j_50": area(joints, true_joints, 50, 20),
    }
    assert line.ours is not None
    assert line.samples == 1
    for name in line.columns:
        # Areas count points below thresholds, of which one may lie at a threshold to float32.
        tolerance = {"abs": 0.003} if "auc" in name else {"rel": 1e-4}
        assert line.ours[name] == pytest.approx(expected[name], **tolerance), name


@pytest.mark.slow
def test_v2_runs_on_all_five_sets(all_places) -> None:
    result = run("v2", all_places)
    absent = [line for line in result.lines if line.ours is None]
    assert {line.label.split(" (")[0] for line in absent} == {"POEM v2-param"}
    assert len(result.lines) - len(absent) == 20
    frame = ReleasedTars(all_places.tars / "Arctic_mv", split="val")[0]
    views = np.random.default_rng((QUIET.seed, 0)).permutation(8)
    line = line_of(result, "ARCTIC-Mv", "POEM v2-large (8 cameras)")
    check_as_poem(line, all_places.checkpoints / "v2-large", frame, views)


def test_row_9_of_v2_is_numpys(places) -> None:
    result = replace_rows(table_named("v2"), "OakInk-Mv").run(places, QUIET)
    absent = [line for line in result.lines if line.ours is None]
    assert [line.label for line in absent] == ["POEM v2-param (4 cameras)"]
    assert "import-torch medium_MANO.pth.tar" in absent[0].absent[0]
    assert str(places.checkpoints / "v2-param") in absent[0].absent[0]
    line = line_of(result, "OakInk-Mv", "POEM v2 (4 cameras)")
    frame = ReleasedTars(places.tars / "Oakink_mv", split="test")[0]
    views = np.random.default_rng((QUIET.seed, 0)).permutation(4)
    check_as_poem(line, places.checkpoints / "v2-base", frame, views)
    assert line.what["protocol"] == "poem-release"
    assert "1 of 46 shards" in line.what["data"]


def test_ho3d_v3_counts_images_and_writes_the_submission(places, tmp_path) -> None:
    result = run("ho3d-v3", places, QUIET._replace(out=str(tmp_path)))
    quoted = next(line for line in result.lines if line.label == "Hamba")
    assert quoted.paper["pa_f_5"] == 0.681
    assert quoted.absent == ()
    check_official(result, places, "v3")


@pytest.mark.slow
def test_ho3d_v2_is_numpys_too_with_its_calibration_beside_it(all_places, tmp_path) -> None:
    result = run("ho3d-v2", all_places, QUIET._replace(out=str(tmp_path)))
    check_official(result, all_places, "v2")
    assert result.lines[-1].samples == 13


def check_official(result: TableResult, places: Places, version: str) -> None:
    """Compare the row with the official evaluation, of the submission and of the labels as they are given."""
    line = line_of(result, f"HO-3D {version}, official", "POEM v2-large")
    source = HO3D(places.raw / "HO3D", split="evaluation-mv", version=version, mano=places.mano)
    assert line.samples == source.num_images
    with zipfile.ZipFile(result.files[0]) as archive:
        joints, vertices = (np.array(part) for part in json.loads(archive.read("pred.json")))
    given = places.raw / "HO3D" / f"HO3D_{version}"
    true_joints, truth = (
        np.array(json.loads((given / f"evaluation_{name}.json").read_text())) for name in ("xyz", "verts")
    )
    assert joints.shape == true_joints.shape
    meshes = [(aligned(*pair), pair[1]) for pair in zip(vertices, truth, strict=True)]
    skeletons = [(aligned(*pair), pair[1]) for pair in zip(joints, true_joints, strict=True)]
    expected = {
        "pa_mpvpe_mm": np.mean([error_mm(*pair) for pair in meshes]),
        "pa_mpjpe_mm": np.mean([error_mm(*pair) for pair in skeletons]),
        "pa_auc_v_50": np.mean([area(*pair, 50, 100) for pair in meshes]),
        "pa_auc_j_50": np.mean([area(*pair, 50, 100) for pair in skeletons]),
        "pa_f_5": np.mean([f_score(*pair, 5) for pair in meshes]),
        "pa_f_15": np.mean([f_score(*pair, 15) for pair in meshes]),
    }
    assert set(expected) == set(line.columns)
    for name, value in expected.items():
        assert line.ours[name] == pytest.approx(value, rel=2e-3, abs=1e-3), name


def test_ho3d_submission_is_not_written_of_a_part(places, tmp_path) -> None:
    result = run("ho3d-v3", places, QUIET._replace(out=str(tmp_path), samples=1))
    assert result.files == ()
    assert "no submission is written" in result.lines[-1].notes[-1]


@pytest.mark.slow
def test_single_view_gets_the_true_root(all_places) -> None:
    line = run("single-view", all_places).lines[0]
    source = HO3D(
        all_places.raw / "HO3D", split="evaluation-mv", version="v2", mano=all_places.mano, sequences=("SM1",)
    )
    frame = source[0]
    truth, true_joints = frame.vertices_cam[0], frame.joints_cam[0]
    joints, vertices, _ = found_by(all_places.checkpoints / "v2-base", frame, [0], true_joints[ROOT_JOINT])
    assert line.ours["pa_mpvpe_mm"] == pytest.approx(error_mm(aligned(vertices, truth), truth), rel=1e-4)
    assert line.ours["pa_mpjpe_mm"] == pytest.approx(
        error_mm(aligned(joints, true_joints), true_joints), rel=1e-4
    )
    assert line.ours["mpvpe_mm"] == pytest.approx(error_mm(vertices, truth), rel=1e-4)


@pytest.mark.parametrize("name", [name for name, table in TABLES.items() if isinstance(table, Table)])
def test_without_data_and_weights_every_row_says_what_to_download(name, tmp_path) -> None:
    table = table_named(name)
    assert isinstance(table, Table)
    nowhere = Places(tmp_path / "data", tmp_path / "weights")
    result = table.run(nowhere, QUIET)
    assert len(result.lines) == len(table.rows)
    for row, line in zip(table.rows, result.lines, strict=True):
        assert line.ours is None
        if isinstance(row.system, Quoted):
            assert not line.absent
            continue
        text = "\n".join(line.absent)
        assert str(nowhere.data) in text
        assert row.data.title in text
        if isinstance(row.system, Checkpoint):
            assert str(nowhere.checkpoints / row.system.name) in text
            assert "poem train" in text
    assert not any(tmp_path.iterdir())


def test_a_checkpoint_of_another_system_is_not_scored(places, tmp_path) -> None:
    elsewhere = replace(places, checkpoints=tmp_path)
    (tmp_path / "v1-oakink").symlink_to(places.checkpoints / "v2-base")
    line = line_of(run("robustness", elsewhere), "OakInk-Mv", "POEM v1")
    assert line.ours is None
    assert "holds another system, a Config; expected v1: poem train" in line.absent[0]


HELD = [
    ("v1", "v1-wo-proj"),
    ("v1-wo-proj", "v1"),
    ("v1-g-emb", "v1"),
    ("v1-wo-pt", "v1"),
    ("v1-1stage", "v1"),
    ("pe-meshtr", "ftl-meshtr"),
    ("v2-base", "v2-large"),
    ("v2-param", "v2-base"),
]


@pytest.mark.parametrize(("held", "wanted"), HELD)
def test_an_ablation_in_the_place_of_another_is_not_scored(tmp_path, monkeypatch, held, wanted) -> None:
    """Of the same class, so that it would run, and give another row's numbers."""
    monkeypatch.setattr(run_module, "read_config", lambda folder: PRESETS[held])
    checkpoint = v2(wanted) if wanted.startswith("v2") else v1(wanted, "oakink")
    (tmp_path / checkpoint.name).mkdir()
    told = run_module._Opened(Places(tmp_path, tmp_path)).system(checkpoint)
    assert f"holds another system, a {type(PRESETS[held]).__name__}; expected {wanted}: poem train" in told


RELEASED_V1 = ("v1", "v1-wo-proj", "v1-g-emb", "v1-gv-emb", "mvp", "pe-meshtr", "ftl-meshtr")


@pytest.mark.parametrize("name", RELEASED_V1)
@pytest.mark.parametrize("dataset", CUBOIDS)
def test_released_and_trained_models_of_every_set_are_the_rows_systems(name, dataset) -> None:
    assert is_of_preset(released(name, dataset=dataset), name)
    trained = v1_paper.configs.get(f"{name}-{dataset}")
    assert trained is None or is_of_preset(trained.model, name)


V2_FILES = [("small", "small"), ("base", "medium"), ("large", "large"), ("param", "medium-mano")]


@pytest.mark.parametrize(("name", "release"), V2_FILES)
def test_released_sizes_of_v2_are_the_rows_systems(name, release) -> None:
    assert is_of_preset(PRESETS[f"v2-{release}-release"], f"v2-{name}")


def test_damaged_data_cost_their_rows_alone(places, tmp_path) -> None:
    damaged = replace(places, data=tmp_path)
    folder = tmp_path / "dataset_tars" / "Oakink_mv"
    folder.mkdir(parents=True)
    (folder / "Oakink_mv_test-000000.tar").write_bytes(b"no tar" * 200)
    result = run("v2", damaged)
    broken = line_of(result, "OakInk-Mv", "POEM v2 (4 cameras)")
    assert "Oakink_mv_test-000000.tar" in broken.absent[0]
    assert "download" in line_of(result, "HO3D-Mv", "POEM v2 (5 cameras)").absent[0]


@pytest.mark.slow
def test_main_and_ablation_run_on_all_sets_and_one_row_each_is_numpys(all_places) -> None:
    tables = [table_named(name) for name in ("main", "ablation")]
    for row in (row for table in tables for row in table.rows):
        if isinstance(row.system, Checkpoint):
            write_small(all_places, row.system.name, row.system.preset)
    dexycb = ReleasedTars(all_places.tars / "DexYCB_mv", split="test")[0]
    file = all_places.keypoints("keypoints/dexycb_test.npz")
    file.parent.mkdir(exist_ok=True)
    np.savez(file, keys=np.array([dexycb.key]), keypoints_px=dexycb.keypoints_px[None])
    main, ablation = (table.run(all_places, QUIET) for table in tables)
    assert [line.absent for line in (*main.lines, *ablation.lines) if line.ours is None] == []
    for label in ("iterative optimisation", "`poem fit`"):
        line = line_of(main, "DexYCB-Mv", label)
        assert str(file) in line.what["system"]
        assert line.what["protocol"] == "poem"
        assert line.ours["mpjpe_mm"] < 8
    # This small MvP is made for three views, of the set's five.
    assert "saw fewer views" in line_of(main, "HO3D-Mv", "MvP").notes[0]
    oakink = ReleasedTars(all_places.tars / "Oakink_mv", split="test")[0]
    ho3d = ReleasedTars(all_places.tars / "HO3D_mv_test", split="test")[0]
    for result, label, group, model, frame in (
        (main, "PE-MeshTR", "OakInk-Mv", "pe-meshtr-oakink", oakink),
        (main, "POEM v1", "HO3D-Mv", "v1-ho3d", ho3d),
        (ablation, "w/o-proj", "OakInk-Mv", "v1-wo-proj-oakink", oakink),
        (ablation, "w/o-pt", "HO3D-Mv", "v1-wo-pt-ho3d", ho3d),
    ):
        line = line_of(result, group, label)
        found = found_by(all_places.checkpoints / model, frame, range(len(frame.images)))
        check_row(line, found, frame, 0, from_mesh=model.startswith("v1"))


def replace_rows(table: Table, group: str) -> Table:
    return replace(table, rows=tuple(row for row in table.rows if row.data.title == group))


@pytest.mark.slow
def test_robustness_tells_what_shuffled_and_foreign_cameras_cost(all_places) -> None:
    for dataset in ("dexycb", "oakink", "ho3d"):
        write_small(all_places, f"v1-{dataset}", "v1")
    result = run("robustness", all_places)
    assert all(line.ours is not None for line in result.lines)
    frame = ReleasedTars(all_places.tars / "HO3D_mv_test", split="test")[0]
    line = line_of(result, "HO3D-Mv", "trained on OakInk")
    check_as_poem(line, all_places.checkpoints / "v1-oakink", frame, range(5))
    shuffled = line_of(result, "DexYCB-Mv", "cameras shuffled")
    dexycb = ReleasedTars(all_places.tars / "DexYCB_mv", split="test")[0]
    drawn = jax.random.uniform(jax.random.fold_in(jax.random.key(QUIET.seed), 0), (1, 8))
    order = np.argsort(np.asarray(drawn[0])).tolist()
    assert order[0] != 0
    joints, vertices, hand = found_by(all_places.checkpoints / "v1-dexycb", dexycb, order)
    first_from_drawn = dexycb.T_cam_from_world[0] @ np.linalg.inv(dexycb.T_cam_from_world[order[0]])
    R, t = first_from_drawn[:3, :3], first_from_drawn[:3, 3]
    check_row(shuffled, (joints @ R.T + t, vertices @ R.T + t, hand), dexycb, 0, from_mesh=True)
    assert shuffled.ours["mpvpe_mm"] != line_of(result, "DexYCB-Mv", "POEM v1").ours["mpvpe_mm"]


def test_key_points_of_ones_own_capture_lie_within_it(tmp_path) -> None:
    stored = tmp_path / "data" / "keypoints" / "real_world.npz"
    own = tmp_path / "capture" / "keypoints.npz"
    for file in (stored, own):
        file.parent.mkdir(parents=True)
        np.savez(file, keys=np.array(["a"]), keypoints_px=np.zeros((1, 2, 21, 2)))
    fitting = table_named("real-world").rows[0].system
    places = Places(tmp_path / "data")
    assert run_module._Opened(places).keypoints(fitting) == stored
    assert run_module._Opened(replace(places, own_capture=own.parent)).keypoints(fitting) == own
    own.unlink()
    assert run_module._Opened(replace(places, own_capture=own.parent)).keypoints(fitting) is None


@pytest.mark.slow
def test_real_world_compares_a_fit_to_key_points_with_networks(all_places) -> None:
    source = table_named("real-world").rows[0].data.open(all_places).source
    frames = [source[i] for i in range(len(source))]
    file = all_places.data / "keypoints" / "real_world.npz"
    file.parent.mkdir(exist_ok=True)
    keys, points = [frame.key for frame in frames], [frame.keypoints_px for frame in frames]
    np.savez(file, keys=np.array(keys), keypoints_px=np.array(points))
    table = table_named("real-world")
    without_shipped = replace(table, rows=tuple(r for r in table.rows if not isinstance(r.system, Shipped)))
    adam, fit, base = without_shipped.run(all_places, QUIET).lines
    for line in (adam, fit, base):
        assert line.samples == 2
    for line in (adam, fit):
        assert str(file) in line.what["system"]
        # True key points of a hand of the solver's own model.
        assert line.ours["mpvpe_mm"] < 5 < base.ours["mpvpe_mm"]
    errors = []
    for frame in frames:
        _, vertices, _ = found_by(all_places.checkpoints / "v2-base", frame, range(len(frame.images)))
        errors.append(error_mm(vertices, frame.vertices_cam[0]))
    assert base.ours["mpvpe_mm"] == pytest.approx(np.mean(errors), rel=1e-4)
