"""Each mistake that people make is named, alone and with others; good takes are explained by nothing."""

import re

import numpy as np
import pytest

from poem_jax.calibration.hypotheses import HandSize, explain
from poem_jax.calibration.mistakes import HYPOTHESES
from poem_jax.geometry.cameras import project
from poem_jax.geometry.distortion import distort_pixels
from poem_jax.geometry.transforms import invert_rigid, rotation_from_axis_angle
from poem_jax.hand.joint_orders import JOINT_ORDERS
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import BONES, NUM_JOINTS

FRAMES = 5
OPENGL = np.diag([1.0, -1, -1, 1])
SIZE = np.array([1280, 720])


@pytest.fixture(scope="module")
def hands() -> np.ndarray:
    """Hands that curl, in motion, (frame, 21, 3)."""
    rng = np.random.default_rng(2)
    found = []
    for frame in range(FRAMES):
        pose = np.zeros((16, 3))
        pose[1:13, 2] = rng.uniform(0, 0.6, 12)
        pose[0] = rng.normal(0, 0.4, 3)
        found.append(
            np.asarray(hand_mesh(default_hand(), pose, rng.normal(0, 0.7, 10)).joints, float) + 0.02 * frame
        )
    return np.stack(found)


@pytest.fixture(scope="module")
def size() -> HandSize:
    joints = np.asarray(hand_mesh(default_hand(), np.zeros((16, 3)), np.zeros(10)).joints, float)
    a, b = joints[np.array(BONES).T]
    return HandSize(BONES, np.linalg.norm(a - b, axis=-1))


@pytest.fixture
def take(ring, hands):
    """A rig, and the raw key points of a hand in it with a detector's noise."""
    rig = ring(4)
    uv, _ = project(rig.K, rig.T_cam_from_world, hands.reshape(1, -1, 3))
    raw = np.moveaxis(distort_pixels(uv, rig.K, rig.dist).reshape(4, FRAMES, 1, NUM_JOINTS, 2), 0, 2)
    return rig, raw + np.random.default_rng(0).normal(0, 0.7, raw.shape)


def names(findings):
    return [finding.name for finding in findings]


def scaled(T, factor):
    return T * np.array([1, 1, 1, factor])


def with_centres(T):
    return np.concatenate([T[:, :, :3], invert_rigid(T)[:, :, 3:]], -1)


EXTRINSICS = {
    "inverted extrinsics": (invert_rigid, r"map camera points to world points.*write the inverses"),
    "camera axes": (lambda T: OPENGL @ T, r"OpenGL or Blender axes.*diag\(1, -1, -1\)"),
    "camera axes, inverted extrinsics": (lambda T: invert_rigid(OPENGL @ T), "OpenGL.*write the inverses"),
    "centres as t": (with_centres, r"cameras' centres in the world.*t = -R @ centre"),
    "transposed R": (
        lambda T: np.concatenate([invert_rigid(T)[:, :, :3], T[:, :, 3:]], -1),
        "`R` is transposed.*transpose every `R`",
    ),
}


@pytest.mark.parametrize("mistake", EXTRINSICS)
@pytest.mark.parametrize("origin", [[0.0, 0, 0], [1.0, -2, 0.5], [500e3, 4500e3, 300.0]], ids=str)
def test_mistakes_of_extrinsics_are_named(take, size, mistake, origin):
    """About the hand itself and in any other world, maps' worlds included."""
    rig, keypoints = take
    spoil, message = EXTRINSICS[mistake]
    T = rig.T_cam_from_world.copy()
    R_turn = rotation_from_axis_angle(np.array([0.5, -1, 0.3]) * np.any(origin))
    T[:, :3, 3] -= T[:, :3, :3] @ origin
    T[:, :3, :3] = T[:, :3, :3] @ R_turn
    (found,) = explain(rig._replace(T_cam_from_world=spoil(T)), keypoints, size, JOINT_ORDERS)
    assert found.name == mistake
    assert re.search(message, str(found))
    assert not explain(rig._replace(T_cam_from_world=T), keypoints, size, JOINT_ORDERS)


PIXELS = {
    "normalised pixels": (lambda uv: uv / SIZE + 0.5, "shares of the images' width"),
    "normalised pixels from -1 to 1": (lambda uv: 2 * uv / SIZE - 0.5, "from -1 to 1"),
    "row before column": (lambda uv: uv[..., ::-1], "given as (y, x)"),
    "y upwards": (lambda uv: np.stack([uv[..., 0], SIZE[1] - uv[..., 1]], -1), "lower edge"),
    "mirrored pixels": (
        lambda uv: np.stack([SIZE[0] - uv[..., 0], uv[..., 1]], -1),
        "mirrored left to right",
    ),
    "pixels of another resolution": (lambda uv: uv / 2, "of images 0.5 times as large as the rig's"),
}


@pytest.mark.parametrize("mistake", PIXELS)
def test_mistakes_of_pixels_are_named(take, size, mistake):
    rig, keypoints = take
    spoil, words = PIXELS[mistake]
    (found,) = explain(rig, spoil(keypoints), size, JOINT_ORDERS)
    assert found.name == mistake
    assert words in str(found)


@pytest.mark.parametrize("order", JOINT_ORDERS)
def test_orders_of_joints_are_named(take, size, order):
    rig, keypoints = take
    (found,) = explain(rig, keypoints[..., np.argsort(JOINT_ORDERS[order]), :], size, JOINT_ORDERS)
    assert found.name == "joint order"
    assert order in str(found)
    assert "unit" not in str(found)


@pytest.mark.parametrize(
    ("factor", "word"), [(1000, "millimetres"), (100, "centimetres"), (1 / 0.0254, "inches")]
)
def test_units_are_named(take, size, factor, word):
    rig, keypoints = take
    wrong = rig._replace(T_cam_from_world=scaled(rig.T_cam_from_world, factor))
    (found,) = explain(wrong, keypoints, size, JOINT_ORDERS)
    assert found.name == "unit of the rig"
    assert word in str(found)


def test_three_mistakes_at_once(take, size):
    rig, keypoints = take
    wrong = rig._replace(T_cam_from_world=scaled(invert_rigid(OPENGL @ rig.T_cam_from_world), 1000))
    order = np.argsort(JOINT_ORDERS["wrist, then little finger to thumb, each from tip to base"])
    found = explain(wrong, keypoints[..., order, :], size, JOINT_ORDERS)
    assert names(found) == ["camera axes, inverted extrinsics", "joint order", "unit of the rig"]


def test_exchanged_cameras_are_named(take, size):
    rig, keypoints = take
    (found,) = explain(rig, keypoints[:, :, [1, 0, 2, 3]], size, JOINT_ORDERS)
    assert found.name == "cameras exchanged"


def test_no_cause_is_invented(take, size):
    """What no known mistake explains is said to be so, and no unit is blamed."""
    rig, keypoints = take
    rng = np.random.default_rng(5)
    wild = rng.uniform(0, 700, keypoints.shape)
    (found,) = explain(rig, wild, size, JOINT_ORDERS)
    assert found.name == "views disagree"
    (found,) = explain(rig, keypoints[..., rng.permutation(NUM_JOINTS), :], size, JOINT_ORDERS)
    assert found.name == "no hand"
    (found,) = explain(rig, np.full_like(keypoints, np.nan), size, JOINT_ORDERS)
    assert found.name == "views disagree"


def test_good_takes_are_explained_by_nothing(take, size):
    rig, keypoints = take
    assert explain(rig, keypoints, size, JOINT_ORDERS) == []
    assert explain(rig, keypoints[:1], size, JOINT_ORDERS) == []


def test_every_hypothesis_says_what_and_how():
    for hypothesis in HYPOTHESES:
        assert hypothesis.name
        assert hypothesis.fix
        assert not hypothesis.cause.endswith(".")
