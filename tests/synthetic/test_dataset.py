import dataclasses
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from poem_jax.geometry.cameras import project
from poem_jax.hand import default_hand, hand_mesh
from poem_jax.hand.topology import NUM_JOINTS, NUM_VERTICES
from poem_jax.render.zbuffer import NO_FACE, rasterise
from poem_jax.synthetic.config import OccluderConfig, SensorConfig, SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset

CONFIG = SyntheticConfig(num_backgrounds=3)
NO_OBJECTS = OccluderConfig(held_probability=0.0, blocker_probability=0.0, stray_probability=0.0)


@pytest.fixture(scope="module")
def dataset():
    return SyntheticDataset(CONFIG, seed=3)


@pytest.fixture(scope="module")
def samples(dataset):
    return [dataset.render_sample(index) for index in range(4)]


def leaves(batch):
    return [np.asarray(x) for x in (*batch.cameras, *batch[:1], *batch[2:]) if x is not None]


def assert_same(a, b):
    for x, y in zip(leaves(a), leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_shapes_and_types(samples):
    batch, V = samples[0].batch, CONFIG.num_views
    assert batch.views.shape == (V, 128, 128, 3)
    assert batch.views.dtype == np.uint8
    assert batch.keypoints_px.shape == (V, NUM_JOINTS, 2)
    assert batch.vertices_world.shape == (NUM_VERTICES, 3)
    for name in ("joints_world", "vertices_world", "keypoints_px", "pose", "shape"):
        assert getattr(batch, name).dtype == np.float32
    assert batch.cameras.K.dtype == batch.cameras.T_cam_from_world.dtype == np.float32
    assert batch.cameras.view_mask.all()
    assert batch.root_world is None


def test_a_sample_is_a_function_of_seed_and_index(dataset, samples):
    again = SyntheticDataset(CONFIG, seed=3)
    assert_same(again.sample(2), samples[2].batch)
    assert_same(dataset[2], samples[2].batch)
    assert not np.array_equal(again.sample(1).views, samples[2].batch.views)
    other = SyntheticDataset(CONFIG, seed=4).sample(2)
    assert not np.array_equal(other.vertices_world, samples[2].batch.vertices_world)
    assert not np.array_equal(other.views, samples[2].batch.views)


@pytest.mark.parametrize("num_views", [1, 3])
def test_fewer_views_are_the_first_ones(dataset, samples, num_views):
    few, all_views = dataset.sample(1, num_views), samples[1].batch
    np.testing.assert_array_equal(few.views, all_views.views[:num_views])
    np.testing.assert_array_equal(few.cameras.K, all_views.cameras.K[:num_views])
    np.testing.assert_array_equal(
        few.cameras.T_cam_from_world, all_views.cameras.T_cam_from_world[:num_views]
    )
    np.testing.assert_array_equal(few.keypoints_px, all_views.keypoints_px[:num_views])
    np.testing.assert_array_equal(few.vertices_world, all_views.vertices_world)


def test_threads_draw_the_same(dataset, samples):
    with ThreadPoolExecutor(4) as pool:
        drawn = list(pool.map(dataset.sample, [3, 0, 2, 1, 0, 3]))
    for index, batch in zip([3, 0, 2, 1, 0, 3], drawn, strict=True):
        assert_same(batch, samples[index].batch)


def test_global_generators_have_no_say(dataset, samples):
    np.random.seed(0)  # noqa: NPY002 - the point is that it does not matter
    assert_same(dataset.sample(0), samples[0].batch)


def test_key_points_are_the_projected_joints(samples):
    for sample in samples:
        batch = sample.batch
        joints = np.broadcast_to(batch.joints_world, (8, NUM_JOINTS, 3)).astype(np.float64)
        K, T = (np.asarray(m, np.float64) for m in batch.cameras[:2])
        uv, depth = project(K, T, joints)
        np.testing.assert_allclose(uv, batch.keypoints_px, atol=1e-3)
        assert depth.min() > 0.05
        uv32 = project(batch.cameras.K, batch.cameras.T_cam_from_world, joints.astype(np.float32))[0]
        np.testing.assert_allclose(uv32, batch.keypoints_px, atol=0.02)


def test_pose_and_shape_reproduce_the_mesh(samples):
    hand = default_hand()
    for sample in samples:
        batch = sample.batch
        mesh = hand_mesh(hand, batch.pose, batch.shape)
        offset = batch.joints_world[0] - mesh.joints[0]
        np.testing.assert_allclose(mesh.vertices + offset, batch.vertices_world, atol=2e-6)
        np.testing.assert_allclose(mesh.joints + offset, batch.joints_world, atol=2e-6)


def test_extrinsics_are_rigid_and_the_world_is_nobodys_camera(samples):
    T = np.concatenate([sample.batch.cameras.T_cam_from_world for sample in samples]).astype(np.float64)
    R = T[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-6)
    assert np.abs(T - np.eye(4)).max((1, 2)).min() > 0.1


def test_the_hands_silhouette_is_where_its_vertices_project():
    """Without objects, the mask equals an independent rasterisation from K, T and the vertices alone."""
    config = dataclasses.replace(CONFIG, occluders=NO_OBJECTS, supersample=1)
    dataset, hand = SyntheticDataset(config, seed=5), default_hand()
    for index in range(3):
        sample = dataset.render_sample(index)
        scene = dataset.draw_scene(index)
        arm = scene.mesh.faces[scene.mesh.face_material == 0]
        for view in range(4):
            K, T = sample.batch.cameras.K[view], sample.batch.cameras.T_cam_from_world[view]
            uv, depth = project(K, T, sample.batch.vertices_world)
            mask = sample.hand_coverage[view] > 0
            alone = rasterise(np.column_stack([uv, depth]), hand.faces, config.image_hw).face_index != NO_FACE
            all_uv, all_depth = project(K.astype(np.float64), T.astype(np.float64), scene.mesh.vertices)
            both = rasterise(np.column_stack([all_uv, all_depth]), arm, config.image_hw).face_index
            shown = (both != NO_FACE) & (both < len(hand.faces))
            frame = np.zeros_like(mask)
            x0, y0, x1, y1 = np.clip(scene.viewpoints.frame_in_crop[view], 0, 128).round().astype(int)
            frame[y0:y1, x0:x1] = True
            assert (mask & ~alone).sum() <= 0.01 * alone.sum() + 2
            assert (mask ^ (shown & frame)).sum() <= 0.02 * shown.sum() + 2


@pytest.fixture(scope="module")
def free_samples():
    """Captures without objects."""
    dataset = SyntheticDataset(dataclasses.replace(CONFIG, occluders=NO_OBJECTS), seed=3)
    return [dataset.render_sample(index) for index in range(8)]


def test_visible_vertices_lie_on_the_mask(samples, free_samples):
    """Without objects nearly all do; an object may cover those that it lies less than 4 mm before."""
    assert min(shares_on_the_mask(free_samples)) > 0.99
    assert np.mean(shares_on_the_mask(samples)) > 0.98


def shares_on_the_mask(samples):
    shares = []
    for sample in samples:
        K, T, _ = sample.batch.cameras
        vertices = np.broadcast_to(sample.batch.vertices_world, (8, NUM_VERTICES, 3))
        uv = project(K, T, vertices)[0]
        for view in range(8):
            seen = uv[view][sample.vertex_visible[view]]
            if not len(seen):
                continue
            assert ((seen >= 0) & (seen < 128)).all()
            near = sample.hand_coverage[view] > 0
            padded = np.pad(near, 2)
            shifted = [padded[2 + r : 130 + r, 2 + c : 130 + c] for r in (-1, 0, 1) for c in (-1, 0, 1)]
            column, row = seen.astype(int).T
            shares.append(np.any(shifted, axis=0)[row, column].mean())
    return shares


def test_hidden_share_follows_the_objects():
    """Objects alone hide; without them, and with a wide crop in the middle of a frame, nothing is hidden."""
    crop = dataclasses.replace(CONFIG.crop, expand_ratio=2.5)
    cameras = dataclasses.replace(CONFIG.cameras, aim_jitter=0.0, principal_sigma=0.0)
    open_config = dataclasses.replace(CONFIG, crop=crop, cameras=cameras, occluders=NO_OBJECTS)
    blocked = dataclasses.replace(CONFIG.occluders, blocker_probability=1.0)
    closed_config = dataclasses.replace(open_config, occluders=blocked)
    shares = []
    for config in (open_config, closed_config):
        dataset = SyntheticDataset(config, seed=0)
        shares.append(np.stack([dataset.render_sample(i, 4).hidden_share for i in range(4)]))
    assert shares[0].mean() < 0.02
    assert shares[1].mean() > 0.3
    assert shares[1].max() <= 1
    assert shares[1].min() >= 0


def test_joints_of_free_views_are_mostly_visible(samples, free_samples):
    def joints(captures, wanted):
        hidden = np.concatenate([sample.hidden_share for sample in captures])
        return np.concatenate([sample.joint_visible for sample in captures])[wanted(hidden)].mean()

    assert joints(free_samples, lambda hidden: hidden < 0.02) > 0.6
    assert joints(samples, lambda hidden: hidden > 0.5) < 0.5


def test_images_are_pictures(samples):
    """Crops hold contrast, and beyond the frame's end they are black but for blur and noise."""
    views = np.concatenate([sample.batch.views for sample in samples])
    assert np.median(views.std((1, 2, 3))) > 20
    assert 60 < views.mean() < 180


def test_bad_requests_are_refused(dataset):
    with pytest.raises(ValueError, match="`seed` must not be negative; got -1"):
        SyntheticDataset(CONFIG, seed=-1)
    with pytest.raises(ValueError, match="be 1 to 8; got 0 and 9"):
        dataset.sample(0, 9)
    with pytest.raises(ValueError, match="got -1 and 8"):
        dataset.sample(-1)
    with pytest.raises(ValueError, match="at least 1"):
        SyntheticConfig(num_views=0)


def test_an_ideal_sensor_changes_only_pixels(samples):
    sensor = SensorConfig(
        blur_px=(0.0, 0.0), motion_probability=0.0, noise=(0.0, 0.0), jpeg_probability=0.0, white_balance=0.0
    )
    clean = SyntheticDataset(dataclasses.replace(CONFIG, sensor=sensor), seed=3).sample(0)
    np.testing.assert_array_equal(clean.vertices_world, samples[0].batch.vertices_world)
    np.testing.assert_array_equal(clean.cameras.K, samples[0].batch.cameras.K)
    assert not np.array_equal(clean.views, samples[0].batch.views)


def test_workers_need_no_jax():
    code = (
        "import sys; from poem_jax.synthetic.config import SyntheticConfig;"
        "from poem_jax.synthetic.dataset import SyntheticDataset; import poem_jax.data.loader;"
        "SyntheticDataset(SyntheticConfig(num_backgrounds=1), 0).sample(0, 1);"
        "assert 'jax' not in sys.modules, 'jax was imported'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
