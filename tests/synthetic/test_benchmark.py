"""The benchmark's spread is a law: nobody may narrow it to get better numbers."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.synthetic.backgrounds import make_backgrounds
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.poses import POSE_LIMITS, pose_to_angles
from poem_jax.synthetic.scene import draw_body
from poem_jax.synthetic.sensor import warp_background

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "synthetic_benchmark.py"
GOLDEN = Path(__file__).with_name("benchmark_statistics.npz")
SCENES, RENDERED, GOLDEN_SAMPLES = 300, 60, 4
# Wide enough for another processor's rounding, in pictures and their JPEG too.
TOLERANCE = {
    "hidden_share": 0.01,
    "pose": 1e-4,
    "shape": 1e-4,
    "keypoints_px": 0.05,
    "mean": 1.0,
    "spread": 1.0,
}


def load_benchmark():
    spec = importlib.util.spec_from_file_location("synthetic_benchmark", CONFIG)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.benchmark


@pytest.fixture(scope="module")
def dataset():
    return SyntheticDataset(load_benchmark(), seed=1)


@pytest.fixture(scope="module")
def first_samples():
    return statistics(SyntheticDataset(load_benchmark(), seed=0))


@pytest.fixture(scope="module")
def scenes(dataset):
    return [dataset.draw_scene(index) for index in range(SCENES)]


@pytest.fixture(scope="module")
def rendered(dataset):
    return [dataset.render_sample(index) for index in range(RENDERED)]


def directions_world(scene):
    offset = scene.viewpoints.camera_world - scene.body.joints_world.mean(0)
    return offset / np.linalg.norm(offset, axis=-1, keepdims=True)


def octant_shares(directions):
    octant = (directions > 0) @ [1, 2, 4]
    return np.bincount(octant, minlength=8) / len(octant)


def test_every_joint_angle_spreads_over_its_limits(dataset):
    rng = np.random.default_rng(0)
    poses = np.stack([draw_body(dataset.prepared, dataset.config.body, rng).pose for _ in range(1000)])
    spread = pose_to_angles(poses).std(0)
    uniform = (POSE_LIMITS[..., 1] - POSE_LIMITS[..., 0]) / np.sqrt(12)
    assert (spread >= 0.5 * uniform).all()


def test_cameras_stand_in_all_octants_of_world_and_hand(scenes):
    world = np.concatenate([directions_world(scene) for scene in scenes])
    hand = np.concatenate(
        [directions_world(s) @ rotation_from_axis_angle(s.body.pose[0].astype(np.float64)) for s in scenes]
    )
    for directions in (world, hand):
        assert octant_shares(directions).min() > 0.09
        np.testing.assert_allclose(directions.mean(0), 0, atol=0.06)
        np.testing.assert_allclose(np.cov(directions.T), np.eye(3) / 3, atol=0.05)


def test_no_baseline_is_filtered(scenes):
    """The angle between two directions uniform on the sphere has a uniform cosine, from -1 to 1."""
    directions = np.stack([directions_world(scene) for scene in scenes])
    cosine = np.einsum("si,si->s", directions[:, 0], directions[:, 1])
    shares = np.histogram(cosine, bins=4, range=(-1, 1))[0] / len(cosine)
    assert shares.min() > 0.17
    every = np.einsum("svi,swi->svw", directions, directions)[:, *np.triu_indices(8, 1)]
    assert every.max() > 0.999
    assert every.min() < -0.995


def test_distances_lenses_and_rolls(dataset, scenes):
    cameras = dataset.config.cameras
    gaps = np.concatenate(
        [np.linalg.norm(s.viewpoints.camera_world - s.body.joints_world.mean(0), axis=-1) for s in scenes]
    )
    assert cameras.distance_m == (0.3, 1.5)
    assert gaps.min() >= 0.3 - 1e-6
    assert gaps.max() <= 1.5 + 1e-6
    assert np.histogram(gaps, bins=4, range=(0.3, 1.5))[0].min() > 0.2 * len(gaps)
    focal = np.concatenate([s.viewpoints.K_frame[:, 0, 0] / s.viewpoints.frame_wh.max(-1) for s in scenes])
    assert focal.max() / focal.min() > 2.4
    x_axis = np.concatenate([s.viewpoints.T_cam_from_world[:, 0, :3] for s in scenes])
    np.testing.assert_allclose(np.cov(x_axis.T), np.eye(3) / 3, atol=0.05)


def test_enough_views_are_hidden(rendered):
    hidden = np.stack([sample.hidden_share for sample in rendered])
    assert (hidden > 0.2).mean() >= 0.30


def test_shapes_are_standard_normal(scenes):
    shapes = np.stack([scene.body.shape for scene in scenes])
    np.testing.assert_allclose(shapes.mean(0), 0, atol=0.25)
    np.testing.assert_allclose(shapes.std(0), 1, atol=0.15)


def test_places_and_orientations_are_anywhere(scenes):
    roots = np.stack([scene.body.joints_world[ROOT_JOINT] for scene in scenes])
    assert (roots.std(0) > 0.5).all()
    turns = rotation_from_axis_angle(np.stack([s.body.pose[0] for s in scenes]).astype(np.float64))
    np.testing.assert_allclose(turns.mean(0), 0, atol=0.12)


def test_backgrounds_are_not_flat(dataset, scenes):
    """Measured behind the crops, after the warp: a close look at a smooth part may be nearly flat."""
    bank = make_backgrounds(dataset.seed, dataset.config.num_backgrounds)
    np.testing.assert_array_equal(bank, dataset.backgrounds)
    assert len(np.unique(bank.mean((1, 2)).round(), axis=0)) > 0.9 * len(bank)
    behind = [
        warp_background(bank[exposure.background], exposure, dataset.config.image_hw)[0]
        for scene in scenes
        for exposure in scene.exposures
    ]
    contrast = np.array([image.std((0, 1)).max() for image in behind])
    assert (contrast < 4).mean() < 0.015
    assert np.median(contrast) > 15
    assert np.std([image.mean() for image in behind]) > 15


def statistics(dataset: SyntheticDataset) -> dict[str, np.ndarray]:
    """Describe the first samples coarsely: enough to notice any change of the distribution.

    Returns:
        `hidden_share` (sample, view), `pose` (sample, 16, 3), `shape` (sample, 10), `keypoints_px` (sample,
        view, 21, 2), and of the pictures in 4 x 4 cells `mean` and `spread` (sample, view, 4, 4, 3), of 255.
    """
    samples = [dataset.render_sample(index) for index in range(GOLDEN_SAMPLES)]
    batches = [sample.batch for sample in samples]
    views = np.stack([batch.views for batch in batches]).astype(np.float64)
    *lead, height, width, channels = views.shape
    cells = views.reshape(*lead, 4, height // 4, 4, width // 4, channels)
    found = {
        "hidden_share": np.stack([sample.hidden_share for sample in samples]),
        "pose": np.stack([batch.pose for batch in batches]),
        "shape": np.stack([batch.shape for batch in batches]),
        "keypoints_px": np.stack([batch.keypoints_px for batch in batches]),
        "mean": cells.mean((-4, -2)),
        "spread": cells.std((-4, -2)),
    }
    return {name: values.astype(np.float32) for name, values in found.items()}


@pytest.mark.parametrize("name", TOLERANCE)
def test_distribution_is_the_one_trained_on(first_samples, name):
    """If this fails, the benchmark moved: undo the change, or train and measure the shipped weights anew and
    then store new statistics: `np.savez_compressed(GOLDEN, **statistics(SyntheticDataset(benchmark, 0)))`."""
    with np.load(GOLDEN) as stored:
        assert sorted(stored.files) == sorted(TOLERANCE)
        np.testing.assert_allclose(
            first_samples[name],
            stored[name],
            atol=TOLERANCE[name],
            rtol=0,
            err_msg=f"`{name}` of the benchmark's first samples changed: undo that, or train anew",
        )
