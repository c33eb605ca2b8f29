"""Losses against naive NumPy, against the released model's numbers, and blind to what is masked."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.transforms import axis_angle_from_rotation, rotation_from_axis_angle
from poem_jax.hand.model import HandModel, joints_from_vertices
from poem_jax.hand.topology import QueryOrder, join_vertices_first
from poem_jax.losses import (
    PAPER,
    RECIPES,
    RELEASE,
    SYNTHETIC,
    V1,
    Layers,
    LossRecipe,
    Penalty,
    masked_mean,
    multi_view_losses,
    triangulation_term,
)

HW = (128, 96)
GOLDENS = [
    "small_A",
    "small_B",
    "small_C",
    "small_D",
    "medium_A",
    "medium_MANO_A",
    "medium_MANO_B",
    "large_A",
]


@pytest.fixture(scope="module")
def hand() -> HandModel:
    """A random but valid regressor; the losses use nothing else of the hand."""
    rng = np.random.default_rng(0)
    regressor = rng.dirichlet(np.ones(778), 16).astype(np.float32)
    zeros = np.zeros
    return HandModel(
        v_template=zeros((778, 3), np.float32),
        shapedirs=zeros((778, 3, 10), np.float32),
        posedirs=zeros((778, 3, 135), np.float32),
        J_regressor=regressor,
        weights=zeros((778, 16), np.float32),
        faces=zeros((1538, 3), np.int32),
        is_left=np.array(False),
    )


def random_case(views=3, batch=2, joints=1, seed=0) -> tuple[Prediction, MultiViewBatch]:
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return rng.normal(size=shape).astype(np.float32)

    T = np.tile(np.eye(4, dtype=np.float32), (batch, views, 1, 1))
    for b, v in np.ndindex(batch, views):
        T[b, v, :3, :3] = np.linalg.qr(normal(3, 3))[0]
        T[b, v, :3, :3] *= np.sign(np.linalg.det(T[b, v, :3, :3]))
        T[b, v, :3, 3] = [0, 0, 0.8]
    K = np.tile(np.array([[150, 0, 48], [0, 150, 64], [0, 0, 1]], np.float32), (batch, views, 1, 1))
    true_joints, true_vertices = 0.05 * normal(batch, 21, 3), 0.05 * normal(batch, 778, 3)
    layers = 0.05 * normal(batch, 3, 799, 3)
    prediction = Prediction(
        vertices_world=layers[:, -1, :778],
        joints_world=layers[:, -1, 778:],
        root_world=layers[:, -1, 778 + 9],
        keypoints_px=50 + 10 * normal(batch, views, joints, 2),
        layers_world=layers,
        valid=np.ones(batch, bool),
        pose=normal(batch, 16, 3),
        shape=normal(batch, 10),
        reference_joints_world=0.05 * normal(batch, 21, 3),
    )
    truth = MultiViewBatch(
        views=np.zeros((batch, views, *HW, 3), np.uint8),
        cameras=Cameras(K, T),
        joints_world=true_joints,
        vertices_world=true_vertices,
        keypoints_px=project(K, T, true_joints[:, None])[0],
        pose=normal(batch, 16, 3),
        shape=normal(batch, 10),
        sample_mask=np.ones(batch, bool),
    )
    return prediction, truth


def naive_release(prediction, batch, hand, layers, joint_power=2):
    """The release's loss, sample by sample and view by view."""
    diagonal = np.hypot(*HW)
    uv_true = batch.keypoints_px[:, :, 9:10] if prediction.keypoints_px.shape[2] == 1 else batch.keypoints_px
    total = 10 * np.mean(np.sum(((prediction.keypoints_px - uv_true) / diagonal) ** 2, -1))
    for i in range(layers.shape[1]):
        vertices, joints = layers[:, i, :778], layers[:, i, 778:]
        squares, regressed, absolute, pixels = [], [], [], []
        for b in range(len(joints)):
            R = batch.cameras.T_cam_from_world[b, 0, :3, :3]
            squares.append((joints[b] - batch.joints_world[b]) ** 2)
            truth = batch.vertices_world[b]
            difference = joints_from_vertices(hand, vertices[b]) - joints_from_vertices(hand, truth)
            regressed.append(difference**2)
            absolute.append(np.abs((vertices[b] - truth) @ R.T))
            for v in range(batch.views.shape[1]):
                cameras = batch.cameras
                uv = project(cameras.K[b, v], cameras.T_cam_from_world[b, v], joints[b])[0]
                residual = np.clip(uv - batch.keypoints_px[b, v], -diagonal / 2, diagonal / 2)
                pixels.append(np.sum((residual / diagonal) ** 2, -1))
        total += np.mean(squares) + np.mean(regressed) + np.mean(absolute) + np.mean(pixels)
    return total


@pytest.mark.parametrize("joints", [1, 21])
def test_release_and_paper_agree_with_naive_loops(hand, joints):
    prediction, batch = random_case(joints=joints)
    prediction = prediction._replace(pose=None, shape=None)
    for recipe, layers in ((RELEASE, prediction.layers_world[:, -1:]), (PAPER, prediction.layers_world)):
        loss, _ = multi_view_losses(prediction, batch, hand=hand, image_hw=HW, recipe=recipe)
        np.testing.assert_allclose(loss, naive_release(prediction, batch, hand, layers), rtol=1e-5)


def _small_poses(seed: int = 0):
    """A case whose angles stay below a right angle, seen from cameras at the world's origin."""
    prediction, batch = random_case(seed=seed)
    rng = np.random.default_rng(seed)
    pose, truth = (rng.uniform(-0.6, 0.6, batch.pose.shape).astype(np.float32) for _ in range(2))
    T = np.broadcast_to(np.eye(4, dtype=np.float32), batch.cameras.T_cam_from_world.shape)
    cameras = batch.cameras._replace(T_cam_from_world=T)
    return prediction._replace(pose=pose), batch._replace(pose=truth, cameras=cameras)


def test_parametric_terms(hand):
    prediction, batch = _small_poses()
    _, terms = multi_view_losses(prediction, batch, hand=hand, image_hw=HW, recipe=RELEASE)
    np.testing.assert_allclose(terms["pose"], np.mean((prediction.pose - batch.pose) ** 2), rtol=1e-4)
    np.testing.assert_allclose(terms["shape"], np.mean((prediction.shape - batch.shape) ** 2), rtol=1e-5)
    # An angle of 2 pi - a about the opposite axis is the same rotation, so the paper's recipe sees no error.
    angle = np.linalg.norm(batch.pose, axis=-1, keepdims=True)
    same = prediction._replace(pose=(batch.pose * (1 - 2 * np.pi / angle)).astype(np.float32))
    _, terms = multi_view_losses(same, batch, hand=hand, image_hw=HW, recipe=PAPER)
    assert terms["pose"] < 1e-9


@pytest.mark.parametrize("recipe", [RELEASE, PAPER])
def test_the_pose_term_does_not_depend_on_the_world(hand, recipe):
    prediction, batch = _small_poses(1)
    _, before = multi_view_losses(prediction, batch, hand=hand, image_hw=HW, recipe=recipe)
    R = rotation_from_axis_angle(np.array([0.4, -1.1, 0.7], np.float32))

    def turned(pose):
        root = axis_angle_from_rotation(R @ rotation_from_axis_angle(pose[:, 0]))
        return np.concatenate([root[:, None], pose[:, 1:]], 1)

    T = batch.cameras.T_cam_from_world.copy()
    T[..., :3, :3] = R.T
    moved = batch._replace(pose=turned(batch.pose), cameras=batch.cameras._replace(T_cam_from_world=T))
    _, after = multi_view_losses(
        prediction._replace(pose=turned(prediction.pose)), moved, hand=hand, image_hw=HW, recipe=recipe
    )
    np.testing.assert_allclose(after["pose"], before["pose"], rtol=1e-4)


def test_recipes_hold_the_release_weights():
    for recipe in (RELEASE, PAPER):
        weights = (
            recipe.keypoints,
            recipe.joints,
            recipe.regressed_joints,
            recipe.vertices,
            recipe.reprojection,
        )
        assert weights == (10.0, 1.0, 1.0, 1.0, 1.0)
        assert (recipe.pose, recipe.shape, recipe.point_unit_m) == (0.001, 0.0005, 1.0)
        assert recipe.joint_penalty is Penalty.SQUARED
        assert RECIPES[recipe.name] is recipe
    assert (RELEASE.layers, PAPER.layers) == (Layers.LAST, Layers.EVERY)


@pytest.mark.parametrize("name", ["v1", "v1-1stage", "meshtr", "mvp"])
def test_the_first_paper_s_systems_learn_no_pose_and_shape(hand, name):
    prediction, batch = random_case(joints=21)
    changed = prediction._replace(pose=1 + prediction.pose, shape=1 + prediction.shape)
    before, after = (
        multi_view_losses(guess, batch, hand=hand, image_hw=HW, recipe=RECIPES[name])[0]
        for guess in (prediction, changed)
    )
    assert before == after


def test_absolute_penalty_counts_in_the_unit_of_the_recipe(hand):
    prediction, batch = random_case()
    batch = batch._replace(
        cameras=Cameras(batch.cameras.K, np.tile(np.eye(4, dtype=np.float32), (2, 3, 1, 1)))
    )
    _, terms = multi_view_losses(prediction, batch, hand=hand, image_hw=HW, recipe=SYNTHETIC)
    expected = 10 * np.mean(np.abs(prediction.joints_world - batch.joints_world))
    np.testing.assert_allclose(terms["joints"], expected, rtol=1e-5)


def pad(prediction, batch, junk):
    """Append a masked view and a masked sample that hold `junk`."""

    def grown(x, axis):
        return np.concatenate([x, np.full_like(np.take(x, [0], axis), junk)], axis)

    def grown_all(tree, axis, names):
        return tree._replace(**{name: grown(getattr(tree, name), axis) for name in names})

    batch_fields = ("views", "joints_world", "vertices_world", "keypoints_px", "pose", "shape")
    batch = grown_all(grown_all(batch, 1, ("views", "keypoints_px")), 0, batch_fields)
    K, T, mask = batch.cameras
    K, T = grown(grown(K, 1), 0), grown(grown(T, 1), 0)
    mask = np.pad(mask, ((0, 1), (0, 1)))
    mask[-1] = True
    batch = batch._replace(cameras=Cameras(K, T, mask), sample_mask=np.append(batch.sample_mask, False))
    fields = ("vertices_world", "joints_world", "root_world", "keypoints_px", "layers_world", "pose", "shape")
    prediction = grown_all(grown_all(prediction, 1, ("keypoints_px",)), 0, fields)
    return prediction._replace(valid=np.append(prediction.valid, True)), batch


@pytest.mark.parametrize("junk", [0, 77])
def test_padding_changes_neither_losses_nor_gradients(hand, junk):
    prediction, batch = random_case()
    padded, padded_batch = pad(prediction, batch, junk)
    floats = ("vertices_world", "joints_world", "keypoints_px", "layers_world", "pose", "shape")

    def loss(values, prediction, batch):
        whole = prediction._replace(**values)
        return multi_view_losses(whole, batch, hand=hand, image_hw=HW, recipe=PAPER)[0]

    def value_and_grad(prediction, batch):
        values = {name: jnp.asarray(getattr(prediction, name)) for name in floats}
        return jax.jit(jax.value_and_grad(loss))(values, prediction, batch)

    want, want_gradient = value_and_grad(prediction, batch)
    got, got_gradient = value_and_grad(padded, padded_batch)
    np.testing.assert_allclose(got, want, rtol=1e-6)
    for name in floats:
        real, gradient = want_gradient[name], np.array(got_gradient[name])
        kept = tuple(slice(n) for n in real.shape)
        np.testing.assert_allclose(gradient[kept], real, rtol=1e-5, atol=1e-9)
        gradient[kept] = 0
        assert not gradient.any()


def test_unsolved_samples_do_not_count_in_3d(hand):
    prediction, batch = random_case()
    alone = jax.tree.map(lambda x: x[:1], batch)
    first = jax.tree.map(lambda x: x[:1], prediction)
    recipe = replace(RELEASE, keypoints=0.0)
    options = {"hand": hand, "image_hw": HW, "recipe": recipe}
    masked = prediction._replace(valid=np.array([True, False]))
    np.testing.assert_allclose(
        multi_view_losses(masked, batch, **options)[0],
        multi_view_losses(first, alone, **options)[0],
        rtol=1e-6,
    )


def test_triangulated_joints_count_where_their_rays_met():
    """Also in samples whose second stage does not count, for it is this loss that brings those back."""
    prediction, batch = random_case()
    mask = np.ones((2, 21), bool)
    mask[0, [3, 9]] = False

    def term(**changed):
        case = prediction._replace(reference_joints_mask=mask, **changed)
        return triangulation_term(case, batch, recipe=V1)

    squares = (prediction.reference_joints_world - batch.joints_world) ** 2
    astray = np.where(mask[..., None], prediction.reference_joints_world, 7.0).astype(np.float32)
    for changed in ({}, {"valid": np.zeros(2, bool)}, {"reference_joints_world": astray}):
        np.testing.assert_allclose(term(**changed), squares[mask].mean(), rtol=1e-6)
    batch = batch._replace(sample_mask=np.array([True, False]))
    np.testing.assert_allclose(term(), squares[0][mask[0]].mean(), rtol=1e-6)


def test_masked_mean_is_defined_without_entries():
    value, gradient = jax.value_and_grad(masked_mean)(jnp.array([jnp.nan, 1.0]), jnp.zeros(2, bool))
    assert value == 0
    np.testing.assert_array_equal(gradient, 0)
    np.testing.assert_allclose(
        masked_mean(jnp.arange(6.0).reshape(3, 2), jnp.array([True, False, True])), 2.5
    )


def test_shares_of_uneven_shards_add_up():
    values, mask = (
        jnp.arange(8.0).reshape(4, 2),
        jnp.array([[True, True], [True, False], [False] * 2, [True] * 2]),
    )
    shards = (values.reshape(2, 2, 2), mask.reshape(2, 2, 2))
    shares = jax.pmap(lambda v, m: masked_mean(v, m, axis_name="x"), axis_name="x")(*shards)
    np.testing.assert_allclose(shares.sum(), masked_mean(values, mask), rtol=1e-6)


def test_a_world_frame_changes_nothing(hand):
    """Points; `test_the_pose_term_does_not_depend_on_the_world` turns poses."""
    prediction, batch = random_case()
    prediction = prediction._replace(pose=None)
    R = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0].astype(np.float32)
    R *= np.sign(np.linalg.det(R))
    T_new_from_world = np.eye(4, dtype=np.float32)
    T_new_from_world[:3, :3] = R
    T = batch.cameras.T_cam_from_world @ T_new_from_world.T  # the inverse of a rotation
    moved = batch._replace(
        cameras=Cameras(batch.cameras.K, T),
        joints_world=batch.joints_world @ R.T,
        vertices_world=batch.vertices_world @ R.T,
    )
    fields = ("vertices_world", "joints_world", "layers_world", "reference_joints_world")
    turned = prediction._replace(**{name: getattr(prediction, name) @ R.T for name in fields})
    for recipe in RECIPES.values():
        options = {"hand": hand, "image_hw": HW, "recipe": recipe}
        np.testing.assert_allclose(
            multi_view_losses(turned, moved, **options)[0],
            multi_view_losses(prediction, batch, **options)[0],
            rtol=1e-5,
        )


def released_case(folder: Path, name: str) -> tuple[Prediction, MultiViewBatch, dict[str, float]]:
    """Read stored outputs and inputs of the released model; views of a sample are padded to the most."""
    inputs = np.load(folder / f"inputs_{name[-1]}.npz")
    golden = np.load(folder / f"golden_{name}.npz")
    counts = inputs["views"]
    batch, views, first = len(counts), counts.max(), np.cumsum(counts) - counts
    index = np.minimum(first[:, None] + np.arange(views), len(inputs["target_cam_intr"]) - 1)
    T = np.linalg.inv(inputs["target_cam_extr"]).astype(np.float32)[index]
    truth = MultiViewBatch(
        views=np.zeros((batch, views, 256, 256, 3), np.uint8),
        cameras=Cameras(inputs["target_cam_intr"][index], T, np.arange(views) < counts[:, None]),
        joints_world=inputs["master_joints_3d"],
        vertices_world=inputs["master_verts_3d"],
        keypoints_px=inputs["target_joints_2d"][index],
        pose=inputs["mano_pose"][first],
        shape=inputs["mano_shape"][first],
    )
    parametric = {f"{k}": golden[f"pred_{k}"] for k in ("pose", "shape") if f"pred_{k}" in golden}
    prediction = Prediction(
        vertices_world=golden["pred_verts_3d"],
        joints_world=golden["pred_joints_3d"],
        root_world=golden["pred_joints_3d"][:, 9],
        keypoints_px=golden["pred_joints_uv"][index],
        layers_world=np.moveaxis(golden["all_coords_preds"], 0, 1),
        valid=np.ones(batch, bool),
        **parametric,
    )
    losses = {key: float(golden[key]) for key in golden.files if key.startswith("testmode_loss")}
    return prediction, truth, losses


@pytest.mark.parity
@pytest.mark.parametrize("name", GOLDENS)
def test_release_losses_of_stored_outputs(hand, shared_dir, name):
    folder = shared_dir / "reference" / "poem_v2"
    prediction, batch, want = released_case(folder, name)
    hand = hand._replace(J_regressor=np.load(folder / "fake_mano.npz")["J_regressor"])
    loss, got = multi_view_losses(
        prediction, batch, hand=hand, image_hw=(256, 256), recipe=RELEASE, query_order=QueryOrder.JOINTS_FIRST
    )
    names = {
        "keypoints": "heatmap_joints",
        "joints": "3d_joints",
        "regressed_joints": "3d_joints_from_mesh",
        "vertices": "3d_verts",
        "reprojection": "2d_joints",
        "pose": "pose",
        "shape": "shape",
    }
    assert len(got) == len(want) - 2
    for ours, theirs in names.items():
        if ours in got:
            np.testing.assert_allclose(got[ours], want[f"testmode_loss_{theirs}"], rtol=1e-4)
    np.testing.assert_allclose(loss, want["testmode_loss"], rtol=1e-4)


def test_query_orders_differ_only_in_layout(hand):
    prediction, batch = random_case()
    vertices, joints = prediction.layers_world[..., :778, :], prediction.layers_world[..., 778:, :]
    np.testing.assert_array_equal(join_vertices_first(vertices, joints), prediction.layers_world)
    swapped = prediction._replace(layers_world=np.concatenate([joints, vertices], -2))
    options = {"hand": hand, "image_hw": HW, "recipe": LossRecipe("every", layers=Layers.EVERY)}
    one = multi_view_losses(prediction, batch, **options)[0]
    other = multi_view_losses(swapped, batch, query_order=QueryOrder.JOINTS_FIRST, **options)[0]
    np.testing.assert_allclose(one, other, rtol=1e-6)
