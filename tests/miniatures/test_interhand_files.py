"""The tiny InterHand2.6M's own files agree with what was planted, read by plain means."""

import json

import cv2
import numpy as np
import pytest

from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures.interhand import CAMERAS
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand

SPLIT_OF_CAPTURE = {"7": "train", "0": "val", "4": "test"}
FROM_INTERHAND = [20, 3, 2, 1, 0, 7, 6, 5, 4, 11, 10, 9, 8, 15, 14, 13, 12, 19, 18, 17, 16]
"""DATASETS, section 7."""


@pytest.fixture(scope="module")
def written(miniature):
    return miniature("interhand")


def read(written, capture, kind):
    split = SPLIT_OF_CAPTURE[capture]
    path = written.root / "annotations" / split / f"InterHand2.6M_{split}_{kind}.json"
    return json.loads(path.read_text())


def planted(written):
    for frame in written.planted:
        capture, number = frame.key_hint.split("/")
        camera = read(written, capture, "camera")[capture]
        cameras = [[np.array(camera[key][name]) for key in camera] for name in frame.view_names]
        yield frame, capture, number, cameras


def test_joints_in_every_camera_lie_where_planted(written):
    for frame, capture, number, cameras in planted(written):
        world = np.array(read(written, capture, "joint_3d")[capture][number]["world_coord"])
        right = world[:21][FROM_INTERHAND]
        for view, (position, rotation, focal, center) in enumerate(cameras):
            joints = (right - position) @ rotation.T
            np.testing.assert_allclose(joints / 1000, frame.joints_cam[view], atol=1e-7)
            uv = joints[:, :2] / joints[:, 2:] * focal + center
            np.testing.assert_allclose(uv + 0.5, frame.keypoints_px[view], atol=1e-4)


def test_mano_gives_the_planted_vertices_and_the_marked_wrist(written):
    for frame, capture, number, cameras in planted(written):
        fit = read(written, capture, "MANO_NeuralAnnot")[capture][number]["right"]
        pose = np.array(fit["pose"]).reshape(16, 3)
        pose[1:] += stand_in_components().mean.reshape(15, 3)
        mesh = hand_mesh(stand_in_hand(), pose, np.array(fit["shape"]), np.array(fit["trans"]))
        for view, (position, rotation, _, _) in enumerate(cameras):
            vertices = (1000 * mesh.vertices - position) @ rotation.T / 1000
            np.testing.assert_allclose(vertices, frame.vertices_cam[view], atol=1e-6)
            wrist = (1000 * mesh.joints[0] - position) @ rotation.T / 1000
            np.testing.assert_allclose(wrist, frame.joints_cam[view, 0], atol=1e-6)


def test_every_image_of_the_list_exists_with_its_size(written):
    for capture, split in SPLIT_OF_CAPTURE.items():
        data = read(written, capture, "data")
        assert [a["image_id"] for a in data["annotations"]] == [image["id"] for image in data["images"]]
        for image in data["images"]:
            pixels = cv2.imread(str(written.root / "images" / split / image["file_name"]))
            assert pixels.shape == (image["height"], image["width"], 3)


def test_only_single_right_hands_with_joints_and_fit_are_planted(written):
    numbers = {frame.key_hint.split("/")[1] for frame in written.planted if frame.key_hint.startswith("7/")}
    joints, fits = (read(written, "7", kind)["7"] for kind in ("joint_3d", "MANO_NeuralAnnot"))
    assert len(joints) == len(numbers) + 4
    for number, label in joints.items():
        whole = all(valid for (valid,) in label["joint_valid"][:21]) and fits[number]["right"] is not None
        assert (number in numbers) == (label["hand_type"] == "right" and whole)


def test_the_second_frame_lacks_a_camera_and_cameras_41_are_grey(written):
    first, second = written.planted[:2]
    assert first.view_names == CAMERAS
    assert second.view_names == CAMERAS[1:]
    grey = [(image == image[..., :1]).all() for image in first.images]
    assert grey == [name.startswith("41") for name in CAMERAS]
