"""Held-out frames: the end of every take, all hands of an instant together, and never trained on."""

import pickle
from collections import Counter

import numpy as np
import pytest

from poem_jax.data.augmentation_recipes import PAPER
from poem_jax.data.frames import TakesSource
from poem_jax.data.sources.captures import Captures
from poem_jax.data.sources.released_tars import ReleasedTars
from poem_jax.data.view_sampling import AllViews, UniformViews
from poem_jax.miniatures import captures, released_tars
from poem_jax.mixture.config import CapturesSource, MixtureConfig, Part, SyntheticSource
from poem_jax.mixture.held_out import Subset, hold_out
from poem_jax.mixture.samples import Mixture, open_mixture
from poem_jax.synthetic.config import SyntheticConfig
from tests.mixture.fake_frames import FakeFrames

HW = (32, 32)


class Takes(FakeFrames):
    """Two takes, of two hands in each of 10 instants and one hand in each of 5, not in order."""

    @property
    def takes(self) -> np.ndarray:
        two = [(0, instant) for instant in range(10) for _ in range(2)]
        return np.array([(1, instant) for instant in (4, 2, 0, 1, 3)] + two)


def indices(subset: Subset) -> set[int]:
    return set(subset._indices.tolist())


def open_mixed(monkeypatch, share: float, source) -> Mixture:
    monkeypatch.setattr(CapturesSource, "open", lambda _: source)
    config = MixtureConfig(
        (Part(CapturesSource(("x",)), 0.5, UniformViews(), share), Part(SyntheticSource(), 0.5, AllViews())),
        recipe=PAPER,
    )
    captures = SyntheticConfig(image_hw=HW, num_views=3, supersample=1, num_backgrounds=1)
    return open_mixture(config, synthetic=captures, seed=3, image_hw=HW)


def test_the_last_instants_of_every_take_are_held_out():
    source = Takes(length=25)
    assert isinstance(source, TakesSource)
    trained, held_out = hold_out(source, 0.2)
    assert indices(trained) | indices(held_out) == set(range(25))
    assert not indices(trained) & indices(held_out)
    chosen = {tuple(source.takes[i].tolist()) for i in indices(held_out)}
    assert chosen == {(0, 8), (0, 9), (1, 4)}
    assert len(held_out) == 5


def test_a_source_that_tells_no_takes_is_one():
    trained, held_out = hold_out(FakeFrames(length=10), 0.3)
    assert indices(held_out) == {7, 8, 9}
    assert (len(trained), held_out[0].key) == (7, "take/000007")
    assert (trained.name, trained.max_views, trained.fingerprint()) == ("fake train", 3, {"fake.tar": "1"})


@pytest.mark.parametrize(("share", "length", "what"), [(0.2, 1, "to validate on"), (0.99, 10, "to train on")])
def test_a_share_that_leaves_nothing_is_refused(share, length, what):
    with pytest.raises(
        ValueError, match=rf"`held_out` {share} of fake train leaves nothing {what}: its 1 tak"
    ):
        hold_out(FakeFrames(length=length), share)


@pytest.mark.parametrize("length", [2, 3, 10])
def test_a_take_too_short_for_the_share_holds_one_instant_out(length):
    trained, held_out = hold_out(FakeFrames(length=length), 0.01)
    assert (indices(trained), indices(held_out)) == (set(range(length - 1)), {length - 1})


def test_shares_that_mean_nothing_are_refused():
    for source, share in (
        (CapturesSource(("x",)), 1.0),
        (CapturesSource(("x",)), -0.1),
        (SyntheticSource(), 0.1),
    ):
        with pytest.raises(ValueError, match="`held_out` must lie in"):
            Part(source, held_out=share)


def test_held_out_frames_are_never_drawn_and_workers_do_not_get_them(monkeypatch):
    source = FakeFrames(length=10)
    mixture = open_mixed(monkeypatch, 0.3, source)
    seen = Counter()
    read = FakeFrames.__getitem__
    monkeypatch.setattr(FakeFrames, "__getitem__", lambda self, i: seen.update([i]) or read(self, i))
    for position in range(40):
        if mixture._schedule.at(position).part == 0:
            mixture.draw(position, 2)
    assert set(seen) == set(range(7))
    assert mixture.held_out.keys() == {"fake train"}
    assert indices(mixture.held_out["fake train"].source) == {7, 8, 9}
    assert pickle.loads(pickle.dumps(mixture)).held_out == {}


def test_a_held_out_sample_has_all_views_and_is_not_augmented(monkeypatch):
    frames = open_mixed(monkeypatch, 0.3, FakeFrames(length=10)).held_out["fake train"]
    one, same = (frames.sample(1, 8, np.random.default_rng(seed)) for seed in (0, 1))
    assert len(one.views) == 3
    np.testing.assert_array_equal(one.views, same.views)
    np.testing.assert_array_equal(one.cameras.K, same.cameras.K)


def test_without_held_out_frames_nothing_changes(monkeypatch):
    source = FakeFrames(length=10)
    mixture = open_mixed(monkeypatch, 0.0, source)
    assert mixture.parts[0].source is source
    assert mixture.held_out == {}


def test_captures_and_shards_tell_their_takes(tmp_path):
    for name in ("a", "b"):
        captures.write(tmp_path / name, frames=2)
    assert Captures([tmp_path / "a", tmp_path / "b"]).takes.tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]
    released_tars.write("freihand", tmp_path, samples=2)
    shards = ReleasedTars(str(tmp_path / "Freihand_mv" / "Freihand_mv_train-{000000..000001}.tar"))
    assert shards.takes[:, 0].tolist() == [0, 1]
