"""Samples in tar files by number: what is read, what is cached, and what damage is called."""

import os
import pickle
import tarfile

import numpy as np
import pytest

from poem_jax.data import tar_index as tar_index_module
from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.shards import ShardSet, expand_shards
from poem_jax.data.tar_index import tar_index
from tests.data.tars import plain_sample, write_tar


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.mark.parametrize("format", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_every_sample_is_read_back_from_any_shard(tmp_path, format):
    long = "x" * 150 if format != tarfile.USTAR_FORMAT else "x"
    samples = [plain_sample(i) for i in range(7)]
    samples[3] = (f"folder.v2/{long}", samples[3][1])
    shards = [
        write_tar(tmp_path / "a-000000.tar", samples[:4], format=format),
        write_tar(tmp_path / "a-000001.tar", samples[4:], format=format),
    ]
    for _ in ("built", "cached"):
        found = ShardSet(shards, required="label.pyd")
        assert len(found) == 7
        assert found.faults == []
        assert [found.read(i) for i in range(7)] == [files for _, files in samples]
        assert [found.locate(i) for i in range(7)] == [(shards[i // 4], samples[i][0]) for i in range(7)]
    assert found.max_members(r"image_\d+\.jpg") == 2
    again = pickle.loads(pickle.dumps(found))
    assert again.read(5) == samples[5][1]
    with pytest.raises(IndexError, match="sample 7 of 7"):
        found.read(7)


def test_the_index_is_built_once_and_again_when_the_shard_changes(tmp_path, monkeypatch):
    shard = write_tar(tmp_path / "a.tar", [plain_sample(0)])
    built = []
    build = tar_index_module.build_index
    monkeypatch.setattr(tar_index_module, "build_index", lambda path: built.append(path) or build(path))
    first = tar_index(shard)
    assert len(tar_index(shard)) == 1
    assert len(built) == 1
    write_tar(shard, [plain_sample(0), plain_sample(1)])
    assert len(tar_index(shard)) == 2
    os.utime(shard, (1, 1))
    assert len(tar_index(shard)) == 2
    assert len(built) == 3
    assert first.digest() != tar_index(shard).digest()


def test_a_damaged_index_is_made_again(tmp_path, caplog):
    shard = write_tar(tmp_path / "a.tar", [plain_sample(0), plain_sample(1)])
    tar_index(shard)
    cached = tmp_path / ".a.tar.index.npz"
    cached.write_bytes(cached.read_bytes()[:-100])
    assert len(tar_index(shard)) == 2
    assert "made again" in caplog.text
    with np.load(cached) as arrays:
        arrays = dict(arrays)
    np.savez(cached, **{**arrays, "size": arrays["size"] + 2**20})
    assert tar_index(shard).members(1)[0][2] == 300 * 2


def test_an_unwritable_folder_keeps_its_index_in_the_users_cache(tmp_path, monkeypatch):
    shard = write_tar(tmp_path / "data" / "a.tar", [plain_sample(0)])
    whole_file = tar_index_module.whole_file

    def refuse(path):
        if path.parent == shard.parent:
            raise PermissionError(13, "Permission denied")
        return whole_file(path)

    monkeypatch.setattr(tar_index_module, "whole_file", refuse)
    tar_index(shard)
    assert [p.name for p in shard.parent.iterdir()] == ["a.tar"]
    monkeypatch.setattr(tar_index_module, "build_index", None)
    assert len(tar_index(shard)) == 1


@pytest.mark.parametrize("cut", ["in an image", "in a header", "between files"])
def test_a_truncated_shard_keeps_what_lies_before_the_cut(tmp_path, cut):
    samples = [plain_sample(i) for i in range(3)]
    shard = write_tar(tmp_path / "a-000000.tar", samples)
    members = tar_index(shard).members(2)
    end = {
        "in an image": members[1][1] + 5,
        "in a header": members[1][1] - 100,
        "between files": members[1][1] - 512,
    }
    os.truncate(shard, end[cut])
    found = ShardSet([shard], required="label.pyd")
    assert [found.read(i) for i in range(len(found))] == [files for _, files in samples[:2]]
    message = " ".join(map(str, found.faults))
    assert "a-000000.tar" in message
    assert "breaks off" in message
    assert "000001" in message or "000002" in message


def test_damage_in_the_middle_is_no_silent_end(tmp_path):
    shard = write_tar(tmp_path / "a.tar", [plain_sample(i) for i in range(3)])
    place = tar_index(shard).members(1)[0][1]
    data = bytearray(shard.read_bytes())
    data[place - 512 : place] = b"garbage!" * 64
    shard.write_bytes(data)
    found = ShardSet([shard], required="label.pyd")
    assert len(found) == 1
    assert "the last sample before is 000000" in str(found.faults[0])


def test_empty_shards_duplicates_and_samples_without_label_are_named(tmp_path):
    no_label = ("000007", {"image_0.jpg": b"x"})
    twice = ("000008", {**plain_sample(8)[1]})
    shards = [
        write_tar(tmp_path / "empty.tar", []),
        tmp_path / "nothing.tar",
        write_tar(tmp_path / "some.tar", [plain_sample(1), no_label, twice, plain_sample(2), twice]),
        write_tar(tmp_path / "adjacent.tar", [plain_sample(3), plain_sample(3), plain_sample(4)]),
    ]
    shards[1].touch()
    found = ShardSet(shards, required="label.pyd")
    assert [found.locate(i)[1] for i in range(len(found))] == ["000001", "000008", "000002", "000004"]
    faults = {(os.path.basename(f.path), f.key): f.problem for f in found.faults}
    assert "holds no file" in faults["empty.tar", "-"]
    assert "empty" in faults["nothing.tar", "-"]
    assert faults["some.tar", "000007"] == "it has no label.pyd"
    assert "twice in the shard" in faults["some.tar", "000008"]
    assert "come twice in this sample" in faults["adjacent.tar", "000003"]
    assert len(faults) == 5
    with pytest.raises(ValueError, match=r"no whole sample in 2 shards.*empty\.tar"):
        ShardSet(shards[:2], required="label.pyd")


def test_a_shard_that_shrinks_after_it_was_opened_is_named(tmp_path):
    shard = write_tar(tmp_path / "a.tar", [plain_sample(0), plain_sample(1)])
    found = ShardSet([shard])
    os.truncate(shard, 2000)
    with pytest.raises(CorruptSampleError, match=r"a\.tar, sample 000001: the shard ends .* bytes too early"):
        found.read(1)
    shard.unlink()
    with pytest.raises(CorruptSampleError, match="No such file"):
        found.read(0)


def test_patterns_folders_and_lists_are_expanded(tmp_path):
    shards = [write_tar(tmp_path / f"D_mv_train-{i:06d}.tar", [plain_sample(i)]) for i in range(3)]
    assert expand_shards(tmp_path) == tuple(shards)
    assert expand_shards(f"{tmp_path}/D_mv_train-{{000000..000002}}.tar") == tuple(shards)
    assert expand_shards(f"{tmp_path}/D_mv_*-*1.tar") == (shards[1],)
    assert expand_shards([shards[2], str(shards[0])]) == (shards[2], shards[0])
    with pytest.raises(FileNotFoundError, match=r"2 of 5 shards are missing: .*000003\.tar, .*000004\.tar$"):
        ShardSet(expand_shards(f"{tmp_path}/D_mv_train-{{000000..000004}}.tar"))
    with pytest.raises(FileNotFoundError, match="no file fits the pattern"):
        expand_shards(f"{tmp_path}/X*.tar")
    (tmp_path / "none").mkdir()
    with pytest.raises(FileNotFoundError, match="no tar file in the folder"):
        expand_shards(tmp_path / "none")
    with pytest.raises(ValueError, match="listed twice"):
        ShardSet([shards[0], shards[0]])


def test_the_fingerprint_names_the_shard_that_changed(tmp_path):
    shards = [write_tar(tmp_path / f"{i}.tar", [plain_sample(i)]) for i in range(2)]
    before = ShardSet(shards).fingerprint()
    write_tar(shards[1], [plain_sample(5)])
    after = ShardSet(shards).fingerprint()
    assert [name for name in before if before[name] != after[name]] == ["1.tar"]


def test_hidden_files_are_no_shards(tmp_path):
    """macOS puts `._NAME` beside a copied file, and a run that was killed leaves `.NAME.1a2b3c4d.tar`."""
    shard = write_tar(tmp_path / "D_mv_train-000000.tar", [plain_sample(0)])
    for name in ("._D_mv_train-000000.tar", ".D_mv_train-000001.1a2b3c4d.tar"):
        (tmp_path / name).write_bytes(b"\0\5\26\7")
    assert expand_shards(tmp_path) == (shard,)
    assert expand_shards(f"{tmp_path}/*.tar") == (shard,)
    assert expand_shards(f"{tmp_path}/*D_mv_*") == (shard,)


def test_two_shards_of_one_name_are_refused(tmp_path):
    shards = [write_tar(tmp_path / of / "D_mv_train-000000.tar", [plain_sample(0)]) for of in ("a", "b")]
    with pytest.raises(ValueError, match=r"two shards have one name.*a/D_mv_train.* and .*b/D_mv_train"):
        ShardSet(shards)


def test_keys_with_dots_make_many_endings(tmp_path, monkeypatch):
    """Their samples cannot be told apart, which is named; up to then they are only endings."""
    files = {f"{number:06d}.jpg": b"x" for number in range(300)}
    shard = write_tar(tmp_path / "a.tar", [("frame", files)])
    for _ in ("built", "cached"):
        assert ShardSet([shard]).read(0) == files
    monkeypatch.setattr(tar_index_module, "_MAX_SUFFIXES", 256)
    with pytest.raises(
        ValueError, match=r"a\.tar holds files of 300 different endings.*can hold none itself"
    ):
        tar_index_module.build_index(shard)


@pytest.mark.parametrize("format", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT, tarfile.PAX_FORMAT])
def test_names_that_are_no_utf8_are_read_and_can_be_printed(tmp_path, format):
    key = b"caf\xe9".decode("utf-8", "surrogateescape")
    bad = b"t\xe9".decode("utf-8", "surrogateescape")
    shard = write_tar(
        tmp_path / "a.tar", [(key, {"a.b": b"1", "label.pyd": b"2"}), (bad, {"a": b"3"})], format=format
    )
    for _ in ("built", "cached"):
        found = ShardSet([shard], required="label.pyd")
        assert found.read(0) == {"a.b": b"1", "label.pyd": b"2"}
        assert found.locate(0)[1].encode() == rb"caf\xe9"
        assert str(found.faults[0]).encode().endswith(rb"a.tar, sample t\xe9: it has no label.pyd")
