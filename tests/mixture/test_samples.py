"""Data sets and captures in one mixture; what is corrupt is passed over, and too much of it stops the run."""

import json
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from poem_jax.data.augmentation_recipes import NONE
from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.sources import captures
from poem_jax.data.view_sampling import AllViews, UniformViews
from poem_jax.mixture import samples
from poem_jax.mixture.config import CapturesSource, ImageDecoder, MixtureConfig, Part, SyntheticSource
from poem_jax.mixture.files import check_files
from poem_jax.mixture.report import DataReport, TooManyCorruptSamples
from poem_jax.mixture.samples import Drawn, FrameSamples, LeftOut, Mixture, SyntheticSamples, open_mixture
from poem_jax.mixture.stream import MixtureStream, host_rows
from poem_jax.synthetic.config import SyntheticConfig
from tests.mixture.fake_frames import FakeFrames
from tests.mixture.fakes import FakeSamples

HW = (32, 32)
SHRINKING = replace(NONE, shrinks_while_decoding=True)
CAPTURES = SyntheticConfig(image_hw=HW, num_views=3, supersample=1, num_backgrounds=1)


def frames(pose=False, **options) -> FrameSamples:
    return FrameSamples(FakeFrames(**options), UniformViews(), NONE, HW, pose)


def who(drawn: Drawn) -> tuple:
    """What a fake part's sample says of itself."""
    return drawn.part, *drawn.sample.joints_world[0].tolist()


def test_frames_and_captures_have_the_same_fields():
    parts = [frames(), SyntheticSamples(CAPTURES, 5, AllViews(), False)]
    mixture = Mixture(parts, (0.5, 0.5), seed=5)
    drawn = [mixture.draw(i, 2) for i in range(8)]
    assert {one.part for one in drawn} == {0, 1}
    for one in drawn:
        sample = one.sample
        assert sample.views.shape[1:] == (*HW, 3)
        assert sample.views.dtype == np.uint8
        assert 1 <= len(sample.views) <= 2
        assert sample.pose is None
        assert sample.shape is None
        floats = [*sample.cameras[:2], sample.joints_world, sample.vertices_world, sample.keypoints_px]
        assert {value.dtype for value in floats} == {np.dtype(np.float32)}
    again = Mixture(parts, (0.5, 0.5), seed=5).draw(3, 2).sample
    np.testing.assert_array_equal(again.views, drawn[3].sample.views)


def test_pose_is_kept_where_it_is_asked_for_and_its_lack_named():
    rng = np.random.default_rng(0)
    assert frames(pose=True).sample(0, 2, rng).pose.shape == (16, 3)
    with pytest.raises(ValueError, match=r"sample take/000002 of fake train has no pose .*MANO file"):
        FrameSamples(FakeFrames(pose=False), UniformViews(), NONE, HW, True).sample(2, 2, rng)


def test_a_torn_picture_is_passed_over_for_the_next_frame_of_the_part():
    part = replace_views(frames(damaged=frozenset({2})))
    mixture = Mixture([part], (1.0,), seed=1)
    drawn = [mixture.draw(i, 3) for i in range(5)]
    skipped = [one.skipped for one in drawn if one.skipped]
    assert len(skipped) == 1
    assert skipped[0][0].key == "take/000002"
    assert "2/0.png" in skipped[0][0].problem


def replace_views(part: FrameSamples) -> FrameSamples:
    return replace(part, views=AllViews())


def test_what_stands_for_a_corrupt_sample_depends_on_nothing_but_its_place():
    parts = [FakeSamples("first", 20, bad=frozenset({3, 4, 11})), FakeSamples("second", 9)]
    sound = [FakeSamples("first", 20), FakeSamples("second", 9)]
    mixture = Mixture(parts, (0.7, 0.3), seed=2)
    drawn = [mixture.draw(i, 4) for i in range(100)]
    assert [who(one) for one in reversed(drawn)] == [who(mixture.draw(i, 4)) for i in reversed(range(100))]
    for one, other in zip(
        drawn, (Mixture(sound, (0.7, 0.3), seed=2).draw(i, 4) for i in range(100)), strict=True
    ):
        assert one.part == other.part
        if one.skipped:
            assert who(one)[2] not in (3, 4, 11)
        else:
            assert who(one) == who(other)


def test_a_sample_is_known_by_its_part_and_the_key_of_what_stands_there():
    parts = [FakeSamples("set", 5, bad=frozenset({3})), FakeSamples("set", 9)]
    mixture = Mixture(parts, (0.5, 0.5), seed=2)
    for position in range(40):
        drawn = mixture.draw(position, 4)
        name = ("set", "set (2)")[drawn.part]
        assert mixture.key_at(position, 4) == f"{name} frame{int(drawn.sample.joints_world[0, 1])}"
    part = frames()
    assert part.key(2) == part.source[2].key


def test_a_part_that_is_all_corrupt_ends_the_run():
    part = FakeSamples("first", 60, bad=frozenset(range(60)))
    with pytest.raises(
        ValueError, match=r"50 samples of first in a row are corrupt; the last one: /data/first"
    ):
        Mixture([part], (1.0,), seed=0).draw(0, 1)


def report_of(tmp_path, drawn: int, bad: int, limit=0.01) -> DataReport:
    parts = [FakeSamples("first", 1000, bad=frozenset(range(bad)))]
    mixture, report = Mixture(parts, (1.0,), seed=0), DataReport(tmp_path / "report.json", ["first"], limit)
    for position in range(drawn):
        report.note([mixture.draw(position, 1)])
    return report


def test_corrupt_samples_are_named_in_log_and_report_and_stop_past_a_share(tmp_path, caplog):
    report = report_of(tmp_path, 1000, bad=8, limit=0.05)
    assert caplog.text.count("corrupt sample of first passed over: /data/first.tar, sample frame") == 8
    report.write()
    (entry,) = json.loads(report.file.read_text())
    first = entry["sources"]["first"]
    assert (first["samples"], first["corrupt"]) == (1000, 8)
    assert first["corrupt_samples"]["frame7"] == "/data/first.tar, sample frame7: its label is torn"

    with pytest.raises(
        TooManyCorruptSamples, match=r"of first; the last one is /data/first.tar, sample frame"
    ):
        report_of(tmp_path, 1000, bad=100)
    sittings = json.loads(report.file.read_text())
    assert len(sittings) == 2
    assert sum(sittings[1]["sources"]["first"][name] for name in ("samples", "corrupt")) >= 100
    report_of(tmp_path, 1000, bad=100, limit=0.2)
    report_of(tmp_path, 50, bad=100)


def test_what_a_source_left_out_counts_too(tmp_path):
    report = DataReport(tmp_path / "report.json", ["first"], 0.01)
    report.note_left_out(0, LeftOut(500, 5, ("a.tar is cut off",)))
    (entry,) = json.loads(report.file.read_text())
    assert entry["sources"]["first"]["lost"] == 5
    assert entry["sources"]["first"]["left_out"] == ["a.tar is cut off"]
    with pytest.raises(TooManyCorruptSamples, match=r"about 6 of 506 samples of first .*a.tar is cut off"):
        report.note_left_out(0, LeftOut(500, 6, ("a.tar is cut off",)))
    lost = CorruptSampleError("b.tar", "key", "no label")
    assert frames(faults=[lost]).left_out() == (5, 3, ("b.tar, sample key: no label",))


def test_a_stream_draws_the_same_here_and_writes_its_report(tmp_path):
    mixture = Mixture([FakeSamples("a", 30), FakeSamples("a", 20, faults=("x",))], (0.5, 0.5), seed=3)
    assert mixture.names == ["a", "a (2)"]
    with MixtureStream(mixture, processes=0, run_dir=tmp_path, max_corrupt_share=0.1) as stream:
        samples = stream.samples([7, 3], 2)
    for position, sample in zip((7, 3), samples, strict=True):
        np.testing.assert_array_equal(sample.views, mixture.draw(position, 2).sample.views)
    (entry,) = json.loads((tmp_path / "data_report.json").read_text())
    assert sum(source["samples"] for source in entry["sources"].values()) == 2
    assert entry["sources"]["a (2)"]["left_out"] == ["x"]


def test_hosts_share_a_batch_without_gap_or_overlap():
    for step, size, stride in ((0, 8, 12), (3, 12, 12), (7, 4, 12)):
        whole = host_rows(step, size, stride)
        assert whole == list(range(step * stride, step * stride + size))
        shares = [host_rows(step, size, stride, host=host, hosts=4) for host in range(4)]
        assert {len(share) for share in shares} == {size // 4}
        assert [row for share in shares for row in share] == whole
    with pytest.raises(ValueError, match="cannot be shared evenly"):
        host_rows(0, 6, 12, host=0, hosts=4)


def test_changed_files_are_refused_by_name(tmp_path):
    file = tmp_path / "data_files.json"
    then = {"dexycb": {"0.tar": "1 MB", "1.tar": "2 MB"}, "own": {}}
    check_files(file, then, allow_change=False, begun=False)
    check_files(file, then, allow_change=False, begun=True)
    now = {"dexycb": {"0.tar": "1 MB", "1.tar": "3 MB", "2.tar": "1 MB"}}
    with pytest.raises(
        ValueError, match=r"dexycb: 1.tar: 2 MB -> 3 MB; dexycb: 2.tar: absent -> 1 MB; own is gone"
    ):
        check_files(file, now, allow_change=False, begun=True)
    assert json.loads(file.read_text()) == then
    check_files(file, now, allow_change=True, begun=True)
    assert json.loads(file.read_text()) == now


def test_a_lost_list_of_files_is_not_made_up(tmp_path):
    file, now = tmp_path / "data_files.json", {"dexycb": {"0.tar": "1 MB"}}
    with pytest.raises(
        ValueError, match=r"has checkpoints, but data_files.json is gone.*allow-config-change"
    ):
        check_files(file, now, allow_change=False, begun=True)
    assert not file.exists()
    check_files(file, now, allow_change=True, begun=True)
    assert json.loads(file.read_text()) == now


def test_captures_are_opened_as_the_config_says(monkeypatch):
    asked = []
    monkeypatch.setattr(
        captures, "Captures", lambda *folders, **options: asked.append((*folders, options)) or FakeFrames()
    )
    CapturesSource(("a",), labels=("b.npz",), mano="MANO_RIGHT.pkl", max_reprojection_px=8.0).open()
    assert asked == [(("a",), {"labels": ("b.npz",), "mano": "MANO_RIGHT.pkl", "max_reprojection_px": 8.0})]


@pytest.mark.parametrize("chosen", ImageDecoder)
def test_the_decoder_of_the_config_decodes(monkeypatch, chosen):
    if chosen is ImageDecoder.TURBO:
        pytest.importorskip("simplejpeg")
    monkeypatch.setattr(CapturesSource, "open", lambda _: FakeFrames())
    config = MixtureConfig(parts=(Part(CapturesSource(())),), decoder=chosen)
    mixture = open_mixture(config, synthetic=CAPTURES, seed=0, image_hw=HW)
    used = []
    monkeypatch.setattr(samples, "augment", lambda *_: used.append(_[-1].name) or one_sample())
    mixture.draw(0, 1)
    assert used == [chosen.value]


def one_sample():
    return FakeSamples("any", 1).sample(0, 1, np.random.default_rng(0))


def test_a_decoder_that_is_not_installed_is_named_when_the_mixture_is_opened(monkeypatch):
    monkeypatch.setitem(sys.modules, "simplejpeg", None)
    config = MixtureConfig(parts=(Part(SyntheticSource()),), decoder=ImageDecoder.TURBO)
    with pytest.raises(ModuleNotFoundError, match=r"poem-jax\[turbo\]"):
        open_mixture(config, synthetic=CAPTURES, seed=0, image_hw=HW)


def test_numbers_of_views_are_drawn_for_the_room_a_batch_has(monkeypatch):
    numbers = Counter()
    monkeypatch.setattr(
        samples, "augment", lambda _, views, *__: numbers.update([len(views)]) or one_sample()
    )
    frame = FakeFrames(views=8)[0]
    monkeypatch.setattr(FakeFrames, "__getitem__", lambda *_: frame)
    part, rng = frames(views=8), np.random.default_rng(0)
    for _ in range(400):
        part.sample(0, 4, rng)
    assert sorted(numbers) == [1, 2, 3, 4]
    assert all(abs(count - 100) < 35 for count in numbers.values())


def test_rules_of_a_mixture(tmp_path):
    part = Part(SyntheticSource())
    with pytest.raises(ValueError, match="at least one source"):
        MixtureConfig(parts=())
    with pytest.raises(ValueError, match="`weight` must be positive"):
        Part(SyntheticSource(), weight=0.0)
    with pytest.raises(ValueError, match=r"share of the weights must be at least 0.001; the least is 0.0001"):
        MixtureConfig(parts=(part, replace(part, weight=1e-4)))
    with pytest.raises(ValueError, match=r"must lie in 0..1"):
        MixtureConfig(parts=(part,), max_corrupt_share=2.0)
    with pytest.raises(ValueError, match=r"needs a decoder that can: `mixture.decoder` TURBO; got OPENCV"):
        MixtureConfig(parts=(part,), recipe=SHRINKING)
    MixtureConfig(parts=(part,), recipe=SHRINKING, decoder=ImageDecoder.TURBO)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        open_mixture(
            MixtureConfig(parts=(Part(CapturesSource((str(tmp_path / "nowhere"),))),)),
            synthetic=CAPTURES,
            seed=0,
            image_hw=HW,
        )
