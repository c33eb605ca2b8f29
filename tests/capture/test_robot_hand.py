"""What a robot hand is asked to follow, and what comes of it; by dex-retargeting itself where it is there."""

from types import SimpleNamespace

import numpy as np
import pytest

from poem_jax.capture import robot_hand
from poem_jax.capture.robot_hand import ALLEGRO, follow, packaged_urdf
from poem_jax.cli import main
from poem_jax.hand.joint_limits import anatomical_axes
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand


def closing_hand(frames):
    hand = default_hand()
    pose = np.zeros((frames, 16, 3))
    bend = np.linspace(0, np.deg2rad(70), frames)
    pose[:, 1:13] = bend[:, None, None] * anatomical_axes(hand)[:12, 0]
    return hand_mesh(hand, pose, np.zeros((frames, 10))).joints


@pytest.fixture
def asked(monkeypatch):
    """What a solver is asked, instead of the library."""
    asked = SimpleNamespace(vectors=[], scales=[])

    def solver(robot, urdf, scale):
        asked.scales.append(scale)
        answer = lambda vectors: asked.vectors.append(vectors) or np.array([1.0, len(asked.vectors)])  # noqa: E731
        return SimpleNamespace(retarget=answer, joint_names=["a", "b"])

    monkeypatch.setattr(robot_hand, "_solver", solver)
    return asked


def test_the_fingers_are_made_as_long_as_the_robots(asked, tmp_path):
    joints, valid = closing_hand(5), np.array([True, True, False, True, True])
    joints[2] = np.nan
    motion = follow(ALLEGRO, tmp_path / "robot.urdf", joints, valid)
    assert motion.joint_names == ["a", "b"]
    assert np.isnan(motion.angles[2]).all()
    np.testing.assert_array_equal(motion.angles[valid], [[1, 1], [1, 2], [1, 3], [1, 4]])
    # The middle finger is straight in the first frame, and the robot's length then.
    thumb, index, middle, ring = asked.scales[0] * asked.vectors[0]
    assert np.linalg.norm(middle) == pytest.approx(ALLEGRO.finger_m, abs=0.003)
    assert thumb[1] > index[1] > middle[1] > ring[1]
    follow(ALLEGRO, tmp_path / "robot.urdf", 1.5 * joints, valid)
    assert asked.scales[1] == pytest.approx(asked.scales[0] / 1.5)
    np.testing.assert_allclose(
        asked.scales[1] * asked.vectors[4], asked.scales[0] * asked.vectors[0], atol=1e-6
    )


def test_a_closing_hand_closes_the_robots():
    pytest.importorskip("dex_retargeting")
    motion = follow(ALLEGRO, packaged_urdf(ALLEGRO), closing_hand(8), np.ones(8, bool))
    bending = [motion.joint_names.index(f"joint_{number}.0") for number in (1, 2, 5, 6, 9, 10)]
    assert (motion.angles[-1, bending] - motion.angles[0, bending] > 0.5).all()


def write_prediction(path, sides):
    joints = np.stack([closing_hand(3)] * len(sides), 1)
    np.savez(
        path,
        joints_world=joints,
        valid=np.ones((3, len(sides)), bool),
        hand_side=np.array(sides),
        frames=np.array(["a", "b", "c"]),
        time_s=np.arange(3.0),
    )
    return path


def test_the_command_writes_angles_by_frame(asked, tmp_path, capsys):
    prediction = write_prediction(tmp_path / "prediction.npz", ["left", "right"])
    out = tmp_path / "robot.npz"
    urdf = ["--urdf", str(tmp_path / "robot.urdf")]
    assert main(["retarget", str(prediction), "--out", str(out), *urdf]) == 0
    assert "2 joints in 3 of 3 frames" in capsys.readouterr().out
    with np.load(out) as stored:
        assert stored["angles"].shape == (3, 2)
        assert stored["frames"].tolist() == ["a", "b", "c"]
        assert stored["time_s"].tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("sides", "options", "said"),
    [
        (["left"], [], "--hand must be the number of a right hand, as the robot is one"),
        (["right", "right"], [], "holds 0: right, 1: right; got None"),
        (["right", "left"], ["--hand", "1"], "got 1"),
        (["right"], ["--urdf", "/nowhere/robot.urdf"], "no URDF at /nowhere/robot.urdf"),
    ],
)
def test_what_cannot_be_followed_is_told(tmp_path, capsys, sides, options, said):
    prediction = write_prediction(tmp_path / "prediction.npz", sides)
    assert main(["retarget", str(prediction), "--out", str(tmp_path / "robot.npz"), *options]) == 2
    assert said in capsys.readouterr().err
