import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand import topology
from poem_jax.hand.mano_file import load
from poem_jax.hand.model import (
    HandModel,
    hand_mesh,
    joints_from_vertices,
    layer_tips,
    mirror,
    mirror_pose,
)
from poem_jax.hand.template import default_hand

MIRROR = np.array([-1.0, 1.0, 1.0])


def _pose(rng: np.random.Generator, batch: tuple[int, ...] = ()) -> np.ndarray:
    return rng.normal(0.0, 0.4, (*batch, 16, 3))


def _naive_mesh(model: HandModel, pose: np.ndarray, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """MANO written out joint by joint and vertex by vertex: 4x4 matrices down the tree."""
    shaped = model.v_template + np.einsum("vck,k->vc", model.shapedirs, betas)
    joints = model.J_regressor @ shaped
    R = rotation_from_axis_angle(pose)
    feature = np.concatenate([(R[j] - np.eye(3)).ravel() for j in range(1, 16)])
    rest = shaped + np.einsum("vck,k->vc", model.posedirs, feature)
    world, skin = [], []
    for j, parent in enumerate(topology.MANO_PARENTS):
        local = np.eye(4)
        local[:3, :3] = R[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        world.append(local if parent < 0 else world[parent] @ local)
        undo = np.eye(4)
        undo[:3, 3] = -joints[j]
        skin.append(world[j] @ undo)
    vertices = np.zeros_like(rest)
    for v in range(len(rest)):
        matrix = sum(model.weights[v, j] * skin[j] for j in range(16))
        vertices[v] = (matrix @ np.append(rest[v], 1.0))[:3]
    return vertices, np.stack([m[:3, 3] for m in world])


def test_matches_the_naive_loop(hand, rng):
    pose, betas = _pose(rng), rng.normal(size=10)
    vertices, skeleton = _naive_mesh(hand, pose, betas)
    mesh = hand_mesh(hand, pose, betas)
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-12)
    tips = vertices[list(topology.TIP_VERTICES_LAYER)]
    np.testing.assert_allclose(mesh.joints, topology.openpose_joints(skeleton, tips), atol=1e-12)


def test_zero_pose_and_shape_give_the_template(hand):
    mesh = hand_mesh(hand, np.zeros((16, 3)), np.zeros(10))
    np.testing.assert_allclose(mesh.vertices, hand.v_template, atol=1e-12)
    np.testing.assert_allclose(mesh.joints[0], hand.J_regressor[0] @ hand.v_template, atol=1e-12)


def test_root_rotation_turns_the_mesh_about_the_wrist(hand, rng):
    pose, betas, turn = _pose(rng), rng.normal(size=10), rng.normal(size=3)
    pose[0] = 0
    before = hand_mesh(hand, pose, betas)
    pose[0] = turn
    after = hand_mesh(hand, pose, betas)
    R, wrist = rotation_from_axis_angle(turn), before.joints[0]
    np.testing.assert_allclose(after.vertices, (before.vertices - wrist) @ R.T + wrist, atol=1e-12)
    np.testing.assert_allclose(after.joints, (before.joints - wrist) @ R.T + wrist, atol=1e-12)


def test_rotating_the_world_rotates_the_mesh(hand, rng):
    pose, betas = _pose(rng), rng.normal(size=10)
    Q = rotation_from_axis_angle(rng.normal(size=3))
    rotations = rotation_from_axis_angle(pose)
    shaped = hand.shape(betas)
    before = shaped.pose_rotations(rotations).skin()
    rotations[0] = Q @ rotations[0]
    after = shaped.pose_rotations(rotations).skin()
    wrist = before.joints[0]
    np.testing.assert_allclose(after.vertices - wrist, (before.vertices - wrist) @ Q.T, atol=1e-12)


def test_bending_a_finger_moves_only_what_hangs_on_it(hand):
    pose = np.zeros((16, 3))
    pose[2] = [0, 0, 0.7]
    moved = np.linalg.norm(hand_mesh(hand, pose, np.zeros(10)).vertices - hand.v_template, axis=-1)
    assert moved[hand.weights[:, 2:4].sum(axis=1) == 0].max() < 1e-12
    assert moved[topology.TIP_VERTICES_LAYER[1]] > 0.02


def test_translation_and_centre(hand, rng):
    pose, betas, shift = _pose(rng), rng.normal(size=10), rng.normal(size=3)
    plain = hand_mesh(hand, pose, betas)
    placed = hand_mesh(hand, pose, betas, translation=shift, center_joint=topology.ROOT_JOINT)
    np.testing.assert_allclose(placed.joints[topology.ROOT_JOINT], shift, atol=1e-12)
    offset = shift - plain.joints[topology.ROOT_JOINT]
    np.testing.assert_allclose(placed.vertices, plain.vertices + offset, atol=1e-12)


def test_batch_axes(hand, rng, batch):
    pose, betas = _pose(rng, batch), rng.normal(size=(*batch, 10))
    shift = rng.normal(size=(*batch, 3))
    mesh = hand_mesh(hand, pose, betas, shift)
    assert mesh.vertices.shape == (*batch, 778, 3)
    assert mesh.joints.shape == (*batch, 21, 3)
    for index in np.ndindex(*batch):
        one = hand_mesh(hand, pose[index], betas[index], shift[index])
        np.testing.assert_allclose(mesh.vertices[index], one.vertices, atol=1e-12)
        np.testing.assert_allclose(mesh.joints[index], one.joints, atol=1e-12)


def test_one_shape_carries_many_poses(hand, rng):
    poses, betas = _pose(rng, (4,)), rng.normal(size=10)
    many = hand.shape(betas).pose(poses).skin()
    each = hand_mesh(hand, poses, np.broadcast_to(betas, (4, 10)))
    np.testing.assert_allclose(many.vertices, each.vertices, atol=1e-12)
    np.testing.assert_allclose(many.joints, each.joints, atol=1e-12)


def test_mirror_images(hand, rng):
    pose, betas = _pose(rng), rng.normal(size=10)
    left = mirror(hand)
    assert (hand.side, left.side) == ("right", "left")
    right_mesh, left_mesh = hand_mesh(hand, pose, betas), hand_mesh(left, mirror_pose(pose), betas)
    np.testing.assert_allclose(left_mesh.vertices, right_mesh.vertices * MIRROR, atol=1e-12)
    # The middle finger's tip is another vertex of the same tip on a left hand.
    middle = topology.JOINT_NAMES.index("middle_tip")
    others = np.delete(np.arange(21), middle)
    np.testing.assert_allclose(left_mesh.joints[others], (right_mesh.joints * MIRROR)[others], atol=1e-12)
    assert np.linalg.norm(left_mesh.joints[middle] - right_mesh.joints[middle] * MIRROR) < 0.008
    for a, b in zip(mirror(left), hand, strict=True):
        np.testing.assert_array_equal(a, b)


def test_tips_follow_the_side(hand):
    assert tuple(layer_tips(hand)) == topology.TIP_VERTICES_LAYER
    assert tuple(layer_tips(mirror(hand))) == topology.TIP_VERTICES_LAYER_LEFT
    assert topology.TIP_VERTICES_LAYER_LEFT[2] == 445


def test_regressed_joints_at_rest(hand):
    joints = joints_from_vertices(hand, hand.v_template)
    at_rest = hand_mesh(hand, np.zeros((16, 3)), np.zeros(10)).joints
    skeleton = list(topology.SKELETON_FROM_OPENPOSE)
    np.testing.assert_allclose(joints[skeleton], at_rest[skeleton], atol=1e-12)
    tips = [4, 8, 12, 16, 20]
    np.testing.assert_array_equal(joints[tips], hand.v_template[list(topology.TIP_VERTICES_REGRESSED)])


def test_numpy_and_jax_agree_in_float64(hand, rng):
    pose, betas = _pose(rng, (2,)), rng.normal(size=(2, 10))
    expected = hand_mesh(hand, pose, betas)
    with jax.enable_x64(True):
        model = jax.tree.map(jnp.asarray, hand)
        for run in (hand_mesh, jax.jit(hand_mesh)):
            mesh = run(model, jnp.asarray(pose), jnp.asarray(betas))
            assert isinstance(mesh.vertices, jax.Array)
            np.testing.assert_allclose(mesh.vertices, expected.vertices, atol=1e-13)
            np.testing.assert_allclose(mesh.joints, expected.joints, atol=1e-13)


def test_numpy_stays_numpy_and_float32():
    model = default_hand()
    mesh = hand_mesh(model, np.zeros((16, 3), np.float32), np.zeros(10, np.float32))
    assert isinstance(mesh.vertices, np.ndarray)
    assert mesh.vertices.dtype == mesh.joints.dtype == np.float32


def test_gradients_match_differences_and_are_finite_at_rest(hand, rng):
    target = rng.normal(size=(778, 3))
    with jax.enable_x64(True):
        model = jax.tree.map(jnp.asarray, hand)

        def loss(pose, betas):
            return (hand_mesh(model, pose, betas).vertices * target).sum()

        pose, betas = jnp.asarray(_pose(rng)), jnp.asarray(rng.normal(size=10))
        check_grads(loss, (pose, betas), order=1, modes=("fwd", "rev"), rtol=1e-5)
        at_rest = jax.grad(loss, argnums=(0, 1))(jnp.zeros((16, 3)), jnp.zeros(10))
        assert all(np.isfinite(g).all() for g in at_rest)
        assert np.abs(at_rest[0]).max() > 0


def test_vmap_over_the_model(hand, rng):
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), hand, mirror(hand))
    pose = jnp.asarray(_pose(rng), jnp.float32)
    meshes = jax.vmap(lambda model: hand_mesh(model, pose, jnp.zeros(10)))(both)
    left = hand_mesh(mirror(hand), np.asarray(pose), np.zeros(10))
    np.testing.assert_allclose(meshes.joints[1], left.joints, atol=1e-5)


@pytest.mark.parity
@pytest.mark.parametrize("case", ["A", "B", "C"])
def test_released_layer(shared_dir: Path, case: str):
    """The released parametric model's vertices are MANO(pose, shape) centred at joint 9, plus the root."""
    folder = shared_dir / "reference/poem_v2"
    golden = np.load(folder / f"golden_medium_MANO_{case}.npz")
    model = load(folder / "fake_mano.npz")
    root = golden["pred_ref_joints_3d"][:, topology.ROOT_JOINT]
    pose = golden["pred_pose"].reshape(-1, 16, 3)
    mesh = hand_mesh(model, pose, golden["pred_shape"], root, center_joint=topology.ROOT_JOINT)
    np.testing.assert_allclose(mesh.vertices, golden["pred_verts_3d"], atol=1e-6)
    np.testing.assert_allclose(mesh.joints, golden["pred_joints_3d"], atol=1e-6)


def test_no_jax_is_imported():
    code = (
        "import sys, numpy as np, poem_jax.hand as h; import poem_jax.hand.mano_file; "
        "h.hand_mesh(h.default_hand(), np.zeros((16, 3)), np.zeros(10)); "
        "import poem_jax.synthetic.poses as p; p.sample_pose(np.random.default_rng(0), 1); "
        "sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
