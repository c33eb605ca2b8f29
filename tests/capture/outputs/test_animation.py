"""The animation shows what was given, where it was given, upright; whatever it is made of."""

import contextlib

import numpy as np
import pytest

from poem_jax.capture.outputs import animation
from poem_jax.capture.outputs.animation import write_animation
from tests.capture.outputs.conftest import HANDS
from tests.io.gltf import Gltf

FACES = {side: hand.faces for side, hand in HANDS.items()}


def write(take, folder):
    motion = take.motion(folder / "a.npz")
    with contextlib.closing(take.prediction(folder / "b.npz")) as file:
        vertices = file.array("vertices_world")
        said = write_animation(folder / "hands.glb", motion, lambda f, h: vertices[f, h] - take.origin, FACES)
    return motion, Gltf(folder / "hands.glb"), said


def check(take, motion, gltf, tolerance):
    for frame, time in enumerate(motion.time_s):
        seen = gltf.seen(time - motion.time_s[0])
        assert seen.keys() == {
            name for name, there in zip(("right", "left"), take.seen[frame], strict=True) if there
        }
        for index, name in enumerate(("right", "left")):
            if name in seen:
                expected = motion.upright(take.vertices[frame, index])
                np.testing.assert_allclose(seen[name][0], expected, atol=tolerance)
                np.testing.assert_array_equal(seen[name][1], FACES[name])


@pytest.mark.parametrize("uneven", [False, True])
def test_a_skinned_hand_is_the_given_one_at_every_frames_time(planted, tmp_path, uneven):
    take = planted(uneven=uneven)
    motion, gltf, said = write(take, tmp_path)
    np.testing.assert_allclose(motion.time_s, take.time_s)
    check(take, motion, gltf, 3e-5)
    assert [entry["moves_by"] for entry in said.values()] == ["skeleton"] * 2
    assert said["right"]["mean_distance_mm"] < 0.01
    names = [node["name"] for node in gltf.nodes]
    assert {"capture", "right", "left", "right_wrist", "left_index_pip"} <= set(names)


def test_up_is_up(planted, tmp_path):
    """The capture's node alone turns; below it the axes are the rig's."""
    take = planted()
    _, gltf, _ = write(take, tmp_path)
    capture = next(index for index, node in enumerate(gltf.nodes) if node["name"] == "capture")
    turn = gltf.world(capture, 0.0)
    down_of_cameras = take.take.rig.T_cam_from_world[:, 1, :3].mean(0)
    assert (turn[:3, :3] @ down_of_cameras)[1] < -0.9 * np.linalg.norm(down_of_cameras)
    wrist = next(index for index, node in enumerate(gltf.nodes) if node["name"] == "right_wrist")
    place = gltf.at(wrist, "translation", take.time_s[3] - take.time_s[0], None)
    np.testing.assert_allclose(place, take.joints[3, 0, 0], atol=1e-6)


def test_a_far_world_is_shown_from_near_the_cameras(planted, tmp_path):
    """Viewers compute in float32, which knows half metres at 4,500 km."""
    take = planted(far=True)
    motion, gltf, _ = write(take, tmp_path)
    check(take, motion, gltf, 3e-5)


def test_meshes_without_a_pose_get_a_skeleton_that_is_near_them(planted, tmp_path):
    take = planted(pose=False)
    motion, gltf, said = write(take, tmp_path)
    assert said["right"]["pose"] == "found from the joints"
    assert 0.01 < said["right"]["mean_distance_mm"] < 1000 * animation.MAX_SKIN_ERROR_M
    points = gltf.seen(0.0)["right"][0]
    distance = np.linalg.norm(points - motion.upright(take.vertices[0, 0]), axis=-1)
    assert distance.mean() < animation.MAX_SKIN_ERROR_M


def test_where_the_skeleton_does_not_follow_the_vertices_are_kept(planted, tmp_path, monkeypatch):
    monkeypatch.setattr(animation, "MAX_SKIN_ERROR_M", 1e-5)
    take = planted(pose=False)
    motion, gltf, said = write(take, tmp_path)
    assert {entry["moves_by"] for entry in said.values()} == {"vertices"}
    assert "mm from the engine's" in said["left"]["because"]
    check(take, motion, gltf, 1e-5)


def test_a_hand_that_is_never_seen_leaves_no_trace(planted, tmp_path):
    take = planted()
    unseen = [frame._replace(hands=(frame.hands[0], take.frames[0].hands[1])) for frame in take.frames]
    motion, gltf, said = write(take._replace(frames=unseen), tmp_path)
    assert gltf.seen(motion.time_s[4] - motion.time_s[0]).keys() == {"right"}
    assert said["left"]["because"].startswith("it is never seen")
