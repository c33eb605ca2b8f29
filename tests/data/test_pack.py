"""Packing: what is written is read back, whatever the workers and however often it was interrupted."""

import json
import os
import pickle
import select
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

from poem_jax.data import pack as pack_module
from poem_jax.data.manifest import check_shards, read_manifest
from poem_jax.data.pack import pack
from poem_jax.data.sources.released_tars import ReleasedTars
from tests.data.memory_source import MemorySource

ROOT = Path(__file__).parents[2]
DEXYCB = {"set_name": "DexYCB", "split": "train"}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def files_of(folder):
    return {
        path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix in (".tar", ".json")
    }


def test_packed_samples_are_read_back_with_their_images_untouched(tmp_path):
    source = MemorySource(5, corrupt=(3,))
    seen = []
    packed = pack(source, tmp_path / "out", **DEXYCB, samples_per_shard=2, progress=lambda *n: seen.append(n))
    assert [path.name for path in packed.shards] == [f"DexYCB_mv_train-{i:06d}.tar" for i in range(3)]
    assert packed.samples == 4
    assert packed.skipped == ((3, "memory, sample take.3: planted"),)
    assert seen == [(2, 5), (4, 5), (5, 5)]
    read = ReleasedTars(tmp_path / "out")
    for index, number in enumerate([0, 1, 2, 4]):
        frame, expected = read[index], source[number]
        assert [image.data for image in frame.images] == [image.data for image in expected.images]
        np.testing.assert_allclose(frame.joints_cam, expected.joints_cam, atol=1e-6)
        np.testing.assert_allclose(frame.keypoints_px, expected.keypoints_px, atol=1e-3)
        np.testing.assert_allclose(frame.pose_cam, expected.pose_cam, atol=1e-6)
        assert frame.key.endswith(f"/{number:07d}_take_1_{number}")


def test_the_label_is_what_the_releases_reader_takes(tmp_path):
    """Plain lists with one entry a view, `camera -> world` for this set, boxes of twice the side; read with
    the ordinary unpickler, and with names that NumPy 1 has, too."""
    source = MemorySource(1)
    pack(source, tmp_path, **DEXYCB)
    with tarfile.open(tmp_path / "DexYCB_mv_train-000000.tar") as archive:
        names = archive.getnames()
        data = archive.extractfile(names[-1]).read()
    assert [name.partition(".")[2] for name in names] == [*(f"image_{i}.jpg" for i in range(3)), "label.pyd"]
    assert all("." not in name.partition(".")[0] and len(name) < 100 for name in names)
    assert b"numpy._core" not in data
    label, frame = pickle.loads(data), source[0]
    assert label["request_flip"] is False
    for view in range(3):
        np.testing.assert_allclose(
            label["cam_extr"][view] @ frame.T_cam_from_world[view], np.eye(4), atol=1e-5
        )
        index_px = frame.keypoints_px[view] - 0.5
        np.testing.assert_allclose(label["joints_2d"][view], index_px, atol=1e-4)
        np.testing.assert_allclose(label["cam_intr"][view][:2, 2], frame.K[view, :2, 2] - 0.5, atol=1e-4)
        low, high = index_px.min(0), index_px.max(0)
        assert label["bbox_center"][view].tolist() == [int(c) for c in (low + high) / 2]
        assert label["bbox_scale"][view] == pytest.approx(2 * (high - low).max(), abs=1e-3)
        assert tuple(label["raw_size"][view]) == tuple(frame.size_wh[view])
        assert np.reshape(label["mano_pose"][view], -1).shape == (48,)


def test_the_bytes_do_not_depend_on_the_number_of_workers(tmp_path):
    source = MemorySource(5, corrupt=(1,))
    pack(source, tmp_path / "one", **DEXYCB, samples_per_shard=2)
    pack(source, tmp_path / "two", **DEXYCB, samples_per_shard=2, workers=2)
    one, two = files_of(tmp_path / "one"), files_of(tmp_path / "two")
    assert len(one) == 4
    assert one == two


def test_a_stopped_run_goes_on_and_ends_the_same(tmp_path, monkeypatch):
    source = MemorySource(5)
    pack(source, tmp_path / "whole", **DEXYCB, samples_per_shard=2)
    written = []
    write = pack_module.write_shard

    def stop_at_second(task, shard, path):
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(shard)
        return write(task, shard, path)

    monkeypatch.setattr(pack_module, "write_shard", stop_at_second)
    with pytest.raises(KeyboardInterrupt):
        pack(source, tmp_path / "out", **DEXYCB, samples_per_shard=2)
    assert sorted(files_of(tmp_path / "out")) == [
        "DexYCB_mv_train-000000.tar",
        "DexYCB_mv_train.manifest.json",
    ]
    again = []
    monkeypatch.setattr(
        pack_module, "write_shard", lambda task, shard, path: again.append(shard) or write(task, shard, path)
    )
    pack(source, tmp_path / "out", **DEXYCB, samples_per_shard=2)
    assert again == [1, 2]
    assert files_of(tmp_path / "out") == files_of(tmp_path / "whole")


def test_a_shard_of_the_same_size_but_other_bytes_is_written_again(tmp_path):
    source = MemorySource(2)
    packed = pack(source, tmp_path, **DEXYCB)
    before = files_of(tmp_path)
    data = bytearray(packed.shards[0].read_bytes())
    data[700] ^= 1
    packed.shards[0].write_bytes(data)
    pack(source, tmp_path, **DEXYCB)
    assert files_of(tmp_path) == before


def test_what_a_killed_run_left_is_removed_and_nothing_else(tmp_path):
    left = [".DexYCB_mv_train-000003.0a1b2c3d.tar", ".DexYCB_mv_train.manifest.0a1b2c3d.json"]
    others = [".DexYCB_mv_train-000003.tar.index.npz", ".DexYCB_mv_test-000003.0a1b2c3d.tar", "._x.tar"]
    for name in (*left, *others):
        (tmp_path / name).write_bytes(b"part of a shard")
    pack(MemorySource(1), tmp_path, **DEXYCB)
    there = {path.name for path in tmp_path.iterdir()}
    assert there.isdisjoint(left)
    assert there.issuperset(others)


def test_workers_end_when_their_parent_is_killed():
    """The worker holds one end of a pipe; what the other end reads tells that it lives, or is gone."""
    ours, workers = os.pipe()
    parent = subprocess.Popen(
        [sys.executable, "-m", "tests.data.orphan", str(workers)], pass_fds=[workers], cwd=ROOT
    )
    os.close(workers)
    try:
        assert os.read(ours, 1) == b"!"
        parent.kill()
        parent.wait()
        assert select.select([ours], [], [], 10)[0]
        assert os.read(ours, 1) == b""
    finally:
        parent.kill()
        os.close(ours)


def test_a_shard_that_was_cut_is_written_again_and_checksums_tell_the_rest(tmp_path):
    source = MemorySource(4)
    packed = pack(source, tmp_path, **DEXYCB, samples_per_shard=2)
    before = files_of(tmp_path)
    packed.shards[0].write_bytes(packed.shards[0].read_bytes()[:-1024])
    pack(source, tmp_path, **DEXYCB, samples_per_shard=2)
    assert files_of(tmp_path) == before
    manifest = read_manifest(packed.manifest)
    assert check_shards(manifest, tmp_path) == []
    data = bytearray(packed.shards[1].read_bytes())
    data[700] ^= 1
    packed.shards[1].write_bytes(data)
    packed.shards[0].unlink()
    assert check_shards(manifest, tmp_path) == [
        "DexYCB_mv_train-000000.tar is missing",
        "DexYCB_mv_train-000001.tar: its bytes have changed",
    ]


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (MemorySource(3, name="another"), "`source` is 'memory test', not 'another'|another source"),
        (MemorySource(4), "`samples`"),
        (MemorySource(3, version="2"), r"files have changed: list\.txt"),
    ],
)
def test_another_source_is_not_mixed_into_a_folder(tmp_path, other, words):
    pack(MemorySource(3), tmp_path, **DEXYCB)
    with pytest.raises(ValueError, match=words):
        pack(other, tmp_path, **DEXYCB)


def test_a_shard_without_a_sample_is_no_file_and_a_set_without_one_an_error(tmp_path):
    packed = pack(MemorySource(4, corrupt=(0, 1)), tmp_path / "a", **DEXYCB, samples_per_shard=2)
    assert [path.name for path in packed.shards] == ["DexYCB_mv_train-000001.tar"]
    assert sorted(files_of(tmp_path / "a")) == ["DexYCB_mv_train-000001.tar", "DexYCB_mv_train.manifest.json"]
    with pytest.raises(ValueError, match=r"no sample of memory test can be used.*planted"):
        pack(MemorySource(1, corrupt=(0,)), tmp_path / "b", **DEXYCB)


def test_what_tars_cannot_say_stops_the_packing(tmp_path):
    class WithLens(MemorySource):
        def __getitem__(self, index):
            return super().__getitem__(index)._replace(dist=np.zeros((3, 5)))

    with pytest.raises(ValueError, match="has a lens, which released tars have no field for"):
        pack(WithLens(1), tmp_path, **DEXYCB)
    with pytest.raises(ValueError, match="must be named"):
        pack(MemorySource(1), tmp_path, set_name="Hands", split="train")


def test_a_damaged_manifest_is_named(tmp_path):
    packed = pack(MemorySource(1), tmp_path, **DEXYCB)
    content = json.loads(packed.manifest.read_text())
    packed.manifest.write_text(json.dumps({**content, "shards": {"a": {}}}))
    with pytest.raises(
        ValueError, match=r"is no manifest of packed shards .*remove it to pack from the start"
    ):
        pack(MemorySource(1), tmp_path, **DEXYCB)
