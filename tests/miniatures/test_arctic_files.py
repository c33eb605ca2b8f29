"""The tiny ARCTIC's own files agree with what was planted, read by plain means."""

import json

import cv2
import numpy as np
import pytest

from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import transform_points
from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures import arctic
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand


@pytest.fixture(scope="module")
def written(miniature):
    return miniature("arctic")


def data_of(written):
    return written.root / "arctic_data" / "data"


def test_parameters_of_the_entry_less_the_offset_give_the_planted_hand_in_all_cameras(written):
    misc = json.loads((data_of(written) / "meta" / "misc.json").read_text())
    for frame in written.planted:
        subject, sequence, number = frame.key_hint.split("/")
        path = data_of(written) / "raw_seqs" / subject / f"{sequence}.mano.npy"
        right = np.load(path, allow_pickle=True).item()["right"]
        entry = int(number) - misc[subject]["ioi_offset"]
        fingers = (right["pose"][entry] + stand_in_components().mean).reshape(15, 3)
        pose = np.concatenate([right["rot"][entry][None], fingers])
        mesh = hand_mesh(stand_in_hand(), pose, right["shape"], right["trans"][entry])
        for view in range(8):
            T, K = (np.array(misc[subject][name][view]) for name in ("world2cam", "intris_mat"))
            vertices = transform_points(T, mesh.vertices)
            np.testing.assert_allclose(vertices, frame.vertices_cam[view], atol=1e-6)
            tips = vertices[[744, 320, 443, 554, 671]]
            np.testing.assert_allclose(frame.joints_cam[view][4::4], tips, atol=1e-6)
            np.testing.assert_allclose(project_cam(K, tips) + 0.5, frame.keypoints_px[view][4::4], atol=1e-2)


def test_ten_images_at_either_end_are_not_counted(written):
    for frame in written.planted:
        subject, sequence, number = frame.key_hint.split("/")
        path = data_of(written) / "raw_seqs" / subject / f"{sequence}.mano.npy"
        count = len(np.load(path, allow_pickle=True).item()["right"]["rot"])
        assert 10 <= int(number) < count - 10


def test_pictures_have_the_sizes_that_meta_says(written):
    frame = written.planted[0]
    subject, sequence, number = frame.key_hint.split("/")
    misc = json.loads((data_of(written) / "meta" / "misc.json").read_text())
    for view in (1, 2):
        path = data_of(written) / "images" / subject / sequence / str(view) / f"{number}.jpg"
        image = cv2.imread(str(path))
        assert list(image.shape[1::-1]) == misc[subject]["image_size"][view]
        difference = image[..., ::-1].astype(float) - frame.images[view - 1]
        assert np.abs(difference).mean() < 4


def test_no_sequence_is_in_two_splits(written):
    lists = json.loads((data_of(written) / "splits_json" / "protocol_p1.json").read_text())
    every = [name for names in lists.values() for name in names]
    assert set(lists) == {"train", "val", "test"}
    assert len(set(every)) == len(every) == 3


def test_all_frames_of_a_sequence_have_the_one_shape_of_its_file(tmp_path, monkeypatch):
    monkeypatch.setattr(arctic, "_write_images", lambda folder, shown: None)
    monkeypatch.setattr(arctic, "_black", lambda: b"")
    planted = arctic.write(tmp_path, frames=2)
    assert len(planted) == 3
    for frame in planted:
        subject, sequence, _ = frame.key_hint.split("/")
        path = tmp_path / "arctic_data" / "data" / "raw_seqs" / subject / f"{sequence}.mano.npy"
        held = np.load(path, allow_pickle=True).item()
        np.testing.assert_array_equal(held["right"]["shape"], frame.shape)
