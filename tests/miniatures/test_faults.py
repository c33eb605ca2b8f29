"""Each fault is the one that it says, and nothing else of the file changes."""

import pickle
import tarfile

import cv2
import numpy as np
import pytest

from poem_jax.miniatures import faults
from poem_jax.miniatures.released_tars import archive, members_of


def picture():
    image = np.arange(64 * 48 * 3, dtype=np.uint8).reshape(48, 64, 3)
    return cv2.imencode(".jpg", image)[1].tobytes()


def label():
    joints = np.random.default_rng(0).uniform(-0.1, 0.1, (2, 21, 3)).astype(np.float32)
    vertices = np.random.default_rng(1).uniform(-0.1, 0.1, (2, 778, 3)).astype(np.float32)
    extrinsics = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    return {"joints_3d": list(joints), "verts_3d": list(vertices), "cam_extr": list(extrinsics)}


@pytest.fixture
def shard(tmp_path):
    path = tmp_path / "Set_mv_train-000000.tar"
    members = {}
    for key in ("000000000", "000000001"):
        members[f"{key}.image_0.jpg"] = picture()
        members[f"{key}.label.pyd"] = pickle.dumps(label())
    path.write_bytes(archive(members))
    return path


def label_of(shard, key="000000001"):
    return pickle.loads(members_of(shard)[f"{key}.label.pyd"])


def test_a_header_s_bit_makes_a_picture_that_cannot_be_decoded():
    broken = faults.flip_header_bit(picture())
    assert cv2.imdecode(np.frombuffer(broken, np.uint8), 1) is None
    assert differing_bits(broken, picture()) == 1


def test_a_scan_s_bit_makes_another_picture_of_the_same_size():
    broken = faults.flip_scan_bit(picture())
    whole, other = (cv2.imdecode(np.frombuffer(data, np.uint8), 1) for data in (picture(), broken))
    assert differing_bits(broken, picture()) == 1
    assert other.shape == whole.shape
    assert (other != whole).any()


def differing_bits(a, b):
    bits = np.frombuffer(a, np.uint8) ^ np.frombuffer(b, np.uint8)
    return int(np.unpackbits(bits).sum())


def test_an_exif_turn_is_obeyed_by_opencv_and_leaves_the_pixels():
    turned = np.frombuffer(faults.exif_turned(picture()), np.uint8)
    whole = cv2.imdecode(np.frombuffer(picture(), np.uint8), 1)
    assert (cv2.imdecode(turned, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) == whole).all()
    assert (cv2.imdecode(turned, cv2.IMREAD_COLOR) == np.rot90(whole, -1)).all()


def test_a_cut_archive_ends_inside_a_member(shard):
    faults.truncate(shard)
    with pytest.raises(tarfile.ReadError):
        members_of(shard)


def test_an_empty_archive_is_one(shard):
    faults.empty_archive(shard)
    assert members_of(shard) == {}


def test_a_key_comes_twice(shard):
    before = members_of(shard)
    faults.repeat_key(shard, "000000000")
    with tarfile.open(shard) as tar:
        names = tar.getnames()
    assert names == [*before, "000000000.image_0.jpg", "000000000.label.pyd"]


def test_a_copied_shard_has_the_next_number_and_other_keys(shard):
    copy = faults.copy_shard(shard, 1)
    assert copy.name == "Set_mv_train-000001.tar"
    assert not set(faults.keys_of(copy)) & set(faults.keys_of(shard))


def test_labels_lose_what_is_taken_and_keep_the_rest(shard):
    faults.drop_field(shard, "000000001", "verts_3d")
    assert set(label_of(shard)) == {"joints_3d", "cam_extr"}
    assert set(label_of(shard, "000000000")) == {"joints_3d", "cam_extr", "verts_3d"}


def test_a_label_s_numbers_are_spoiled_as_said(shard):
    faults.spoil_field(shard, "000000001", "joints_3d", view=1)
    assert np.isnan(label_of(shard)["joints_3d"]).sum() == 1
    faults.blow_up_hand(shard, "000000001")
    assert np.ptp(label_of(shard)["verts_3d"][0], axis=0).max() == pytest.approx(3, rel=1e-5)
    faults.skew_extrinsic(shard, "000000001")
    rotation = label_of(shard)["cam_extr"][0][:3, :3]
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() > 0.1


def test_a_hostile_pickle_acts_when_it_is_trusted(tmp_path, shard):
    marker = tmp_path / "marker"
    faults.poison_label(shard, "000000001", marker)
    assert not marker.exists()
    label_of(shard)
    assert marker.exists()
    marker.unlink()
    faults.poison(shard, marker)
    pickle.loads(shard.read_bytes())
    assert marker.exists()


def test_members_change_and_go(shard):
    faults.change_member(shard, "000000000.image_0.jpg", faults.exif_turned)
    faults.drop_member(shard, "000000001.image_0.jpg")
    members = members_of(shard)
    assert members.pop("000000000.image_0.jpg") == faults.exif_turned(picture())
    assert set(members) == {"000000000.label.pyd", "000000001.label.pyd"}
