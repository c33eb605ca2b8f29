"""How many samples a damaged shard is counted as, and that it is told of once."""

import logging

import pytest

from poem_jax.data.augmentation_recipes import NONE
from poem_jax.data.frames import DamagedSource
from poem_jax.data.shards import ShardSet
from poem_jax.data.sources.released_tars import ReleasedTars
from poem_jax.data.view_sampling import AllViews
from poem_jax.mixture.report import TooManyCorruptSamples
from poem_jax.mixture.samples import FrameSamples, Mixture
from poem_jax.mixture.stream import MixtureStream
from tests.data.tars import plain_sample, write_tar


@pytest.fixture
def shards(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    names = [tmp_path / f"DexYCB_mv_train-{number:06d}.tar" for number in range(5)]
    return [write_tar(name, [plain_sample(i) for i in range(40)]) for name in names]


def cut(shard, share):
    data = shard.read_bytes()
    shard.write_bytes(data[: int(share * len(data))])


def test_a_shard_that_is_cut_counts_as_what_the_others_have_more(shards):
    assert ShardSet(shards).lost_samples == 0
    cut(shards[3], 0.5)
    found = ShardSet(shards)
    assert len(found.faults) == 1
    assert 18 <= 200 - len(found) <= 22
    assert found.lost_samples == 200 - len(found)
    shards[1].write_bytes(b"")
    assert ShardSet(shards).lost_samples == found.lost_samples + 40
    assert ShardSet(shards[2:4]).lost_samples == found.lost_samples


def test_a_shard_that_is_damaged_within_counts_as_what_its_bytes_hold(shards):
    data = bytearray(shards[0].read_bytes())
    place = data.index(plain_sample(10)[0].encode())
    data[place - place % 512 : place - place % 512 + 512] = b"x" * 512
    shards[0].write_bytes(data)
    found = ShardSet(shards[:1])
    assert len(found) == 10
    assert 27 <= found.lost_samples <= 33


def test_damaged_shards_are_told_of_once_and_stop_the_run(shards, tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    for number in range(5, 17):
        shards.append(shards[0].with_name(f"DexYCB_mv_train-{number:06d}.tar"))
        shards[-1].write_bytes(b"")
    source = ReleasedTars(shards)
    assert isinstance(source, DamagedSource)
    mixture = Mixture([FrameSamples(source, AllViews(), NONE, (32, 32), False)], (1.0,), seed=0)
    with pytest.raises(TooManyCorruptSamples, match=r"about 480 of 680 samples of DexYCB tars train"):
        MixtureStream(mixture, processes=0, run_dir=tmp_path, max_corrupt_share=0.5)
    assert caplog.text.count("000005.tar") == 1
    assert sum("left out of DexYCB tars train" in line for line in caplog.messages) == 11
    assert "left out of DexYCB tars train: 2 more" in caplog.messages
    assert '"lost": 480' in (tmp_path / "data_report.json").read_text()
