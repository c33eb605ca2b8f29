"""The tiny OakInk's own files agree with what was planted, read by plain means."""

import io
import json
import pickle

import cv2
import numpy as np
import pytest

from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import axis_angle_from_rotation, transform_points
from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures.mano_stand_in import stand_in_hand
from poem_jax.miniatures.oakink import VIEWS, sample_name


def samples_of(written):
    """Each planted frame with its (seq_id/timestamp, person, frame)."""
    for frame in written.planted:
        sequence, stamp, person, number = frame.key_hint.split("/")
        yield frame, (f"{sequence}/{stamp}", int(person), int(number))


def load(written, folder, sample):
    path = written.root / "image" / "anno" / folder / f"{sample_name(sample)}.pkl"
    return TensorUnpickler(io.BytesIO(path.read_bytes())).load()


class TensorUnpickler(pickle.Unpickler):
    """Does by hand what torch would."""

    def find_class(self, module, name):
        known = {
            ("torch._utils", "_rebuild_tensor_v2"): rebuild,
            ("torch.storage", "_load_from_bytes"): numbers_of,
        }
        return known[module, name] if module.startswith("torch") else super().find_class(module, name)


def rebuild(numbers, offset, size, strides, requires_grad, hooks):
    return np.lib.stride_tricks.as_strided(numbers[offset:], size, [4 * step for step in strides])


class StorageUnpickler(pickle.Unpickler):
    def find_class(self, module, name):
        assert (module, name) == ("torch", "FloatStorage")
        return name

    def persistent_load(self, pid):
        return pid


def numbers_of(data):
    stream = io.BytesIO(data)
    magic, version, system = (pickle.load(stream) for _ in range(3))
    assert (magic, version, system["little_endian"]) == (0x1950A86A20F9469CFC6C, 1001, True)
    kind, storage, key, place, count, view = StorageUnpickler(stream).load()
    assert (kind, storage, place, view) == ("storage", "FloatStorage", "cpu", None)
    assert pickle.load(stream) == [key]
    assert int.from_bytes(stream.read(8), "little") == count
    numbers = np.frombuffer(stream.read(), "<f4")
    assert len(numbers) == count
    return numbers


@pytest.fixture(scope="module")
def written(miniature):
    return miniature("oakink")


def test_hands_of_every_camera_lie_where_planted(written):
    for frame, (place, person, number) in samples_of(written):
        for view in range(4):
            sample = (place, person, number, view)
            K, joints, vertices = (load(written, name, sample) for name in ("cam_intr", "hand_j", "hand_v"))
            np.testing.assert_allclose(joints, frame.joints_cam[view], atol=1e-6)
            np.testing.assert_allclose(vertices, frame.vertices_cam[view], atol=1e-6)
            np.testing.assert_allclose(project_cam(K, joints) + 0.5, frame.keypoints_px[view], atol=1e-3)


def test_the_world_s_hand_and_the_camera_give_the_camera_s_hand(written):
    for frame, (place, person, number) in samples_of(written):
        for view in range(4):
            info = load(written, "general_info", (place, person, number, view))
            hand = info["hand_anno"]
            pose = axis_angle_from_rotation(rotations(hand["hand_pose"].astype(np.float64)))
            mesh = hand_mesh(stand_in_hand(), pose, hand["hand_shape"], hand["hand_tsl"], center_joint=0)
            vertices_cam = transform_points(info["cam_extr"], mesh.vertices)
            np.testing.assert_allclose(vertices_cam, frame.vertices_cam[view], atol=1e-5)


def rotations(wxyz):
    """Kuipers 1999, equation 5.11."""
    w, x, y, z = np.moveaxis(wxyz, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def test_lists_name_only_samples_whose_files_exist_and_no_sample_twice(written):
    image = written.root / "image"
    for path in image.rglob("*split*/**/*.json"):
        samples = json.loads(path.read_text())
        assert len({tuple(sample) for sample in samples}) == len(samples)
        for place, person, number, view in samples:
            assert (image / "stream_release_v2" / place / f"{VIEWS[view]}_{number}.png").is_file()
            name = sample_name((place, person, number, view))
            for folder in ("cam_intr", "hand_j", "hand_v", "general_info", "obj_transf"):
                assert (image / "anno" / folder / f"{name}.pkl").is_file()


def test_the_official_list_lacks_a_view_that_the_multi_view_list_has(written):
    split = "split/split2/seq_train.json"
    official, multi_view = (
        {tuple(sample) for sample in json.loads((written.root / "image" / folder / split).read_text())}
        for folder in ("anno", "anno_mv")
    )
    assert len(multi_view - official) == 1
    assert official < multi_view
    assert len(multi_view) % 4 == 0


def test_pictures_are_what_was_planted(written):
    frame, (place, _, number) = next(samples_of(written))
    path = written.root / "image" / "stream_release_v2" / place / f"{VIEWS[1]}_{number}.png"
    assert (cv2.imread(str(path))[..., ::-1] == frame.images[1]).all()
    assert frame.images[1].shape == (480, 848, 3)
