"""Any system on any source: what a sample is, what is averaged, and what is said of the rest."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from poem_jax.data.augmentation_recipes import NONE
from poem_jax.data.frames import CorruptSampleError
from poem_jax.data.view_sampling import FixedViews, UniformViews
from poem_jax.evaluation.dataset import SetSettings, is_of_hand, score_set, standard_error
from poem_jax.evaluation.metrics import evaluate, evaluate_joints
from poem_jax.evaluation.robustness import shuffle_cameras
from poem_jax.evaluation.systems import Answer, Network
from poem_jax.hand.model import mirror
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.tables.run import notes_of
from tests.mixture.fake_frames import FakeFrames
from tests.tables.numpy_errors import error_mm

QUIET = SetSettings(batch_size=2, progress=False)


@dataclass
class Known:
    """Gives the truth, moved by a millimetre more with each sample, and remembers what it was given."""

    least_views: int = 2
    takes_root: bool = True
    unsolved: frozenset[str] = frozenset()
    most_views: int | None = None
    one_at_a_time: bool = False
    hand = default_hand()
    image_hw = (16, 16)
    recipe = NONE
    roots: list = field(default_factory=list)
    batches: list = field(default_factory=list)
    seen: list = field(default_factory=list)
    bends: bool = True

    def __call__(self, batch, seen):
        count = len(seen)
        self.batches.append(batch)
        self.roots += list(batch.root_world[:count])
        noise = np.random.default_rng(len(self.seen)).normal(0, 2e-3, (len(batch.views), 799, 3))
        noise[count:] = 1e3  # what pads a batch must not count
        self.seen += list(seen)
        valid = np.ones(len(batch.views), bool)
        valid[:count] = [one.frame.key not in self.unsolved for one in seen]
        return Answer(batch.joints_world + noise[:, 778:], batch.vertices_world + noise[:, :778], valid)


def answers(system: Known, scores) -> tuple[list, list]:
    """The hands of the system again, beside the labels of each sample's first view."""
    truth = [
        (one.frame.joints_cam[one.views[0]], one.frame.vertices_cam[one.views[0]]) for one in system.seen
    ]
    found, at = [], 0
    for batch in system.batches:
        count = min(len(batch.views), len(system.seen) - at)
        noise = np.random.default_rng(at).normal(0, 2e-3, (len(batch.views), 799, 3))
        found += [
            (batch.joints_world[i] + noise[i, 778:], batch.vertices_world[i] + noise[i, :778])
            for i in range(count)
        ]
        at += count
    assert len(found) == len(scores.keys)
    return found, truth


@pytest.mark.parametrize("protocol", ["poem", "poem-release", "ho3d", "dexycb"])
def test_means_over_samples_are_the_protocols_numbers(protocol) -> None:
    system = Known()
    scores = score_set(system, FakeFrames(length=5), replace(QUIET, protocol=protocol))
    assert scores.keys == tuple(f"take/{i:06d}" for i in range(5))
    found, truth = answers(system, scores)
    together = evaluate(
        *(np.stack([hand[part] for hand in hands]) for part in (0, 1) for hands in (found, truth)),
        protocol=protocol,
        hand=system.hand,
    )
    assert set(scores.means) == set(together)
    for name, value in together.items():
        # Areas: float32 hands of a world and of a camera may lie on either side of a threshold.
        assert scores.means[name] == pytest.approx(value, rel=1e-4, abs=2e-4), name
    direct = [error_mm(*pair) for pair in zip([f[1] for f in found], [t[1] for t in truth], strict=True)]
    np.testing.assert_allclose(scores.rows["mpvpe_mm"], direct, rtol=1e-4)
    assert scores.standard_errors["mpvpe_mm"] == pytest.approx(np.std(direct, ddof=1) / np.sqrt(5), rel=1e-3)


def test_one_shape_of_batch_serves_all_samples_and_padding_does_not_count() -> None:
    system = Known()
    scores = score_set(system, FakeFrames(length=5, views=4), replace(QUIET, cameras=UniformViews(2, 3)))
    assert {batch.views.shape for batch in system.batches} == {(2, 4, 16, 16, 3)}
    assert [bool(batch.sample_mask.all()) for batch in system.batches] == [True, True, False]
    assert {len(one.views) for one in system.seen} <= {2, 3}
    assert scores.means["mpvpe_mm"] < 5


def test_views_that_a_system_has_no_room_for_are_told() -> None:
    scores = score_set(Known(most_views=2), FakeFrames(length=3, views=4), QUIET)
    assert not scores.left_out
    assert scores.num_cut == 3
    assert "of 3 samples the system saw fewer views" in notes_of(scores)[0]
    two = replace(QUIET, cameras=FixedViews(2))
    assert score_set(Known(most_views=2), FakeFrames(length=3, views=4), two).num_cut == 0
    assert score_set(Known(), FakeFrames(length=3, views=4), QUIET).num_cut == 0
    rule, at_random = UniformViews(2, 4), replace(QUIET, cameras=UniformViews(2, 4))
    drawn = [len(rule.draw(4, np.random.default_rng((QUIET.seed, index)))) for index in range(9)]
    scores = score_set(Known(most_views=3), FakeFrames(length=9, views=4), at_random)
    seen = [len(rule.draw(4, np.random.default_rng((QUIET.seed, index)), 3)) for index in range(9)]
    assert scores.num_cut == sum(a > b for a, b in zip(drawn, seen, strict=True)) > drawn.count(4)


def test_cameras_are_drawn_from_the_seed_alone() -> None:
    def drawn(seed: int, size: int) -> list:
        system = Known()
        rule = replace(QUIET, cameras=UniformViews(2, 4), seed=seed, batch_size=size)
        score_set(system, FakeFrames(length=6, views=4), rule)
        return [one.views.tolist() for one in system.seen]

    assert drawn(1, 2) == drawn(1, 3)
    assert len(set(map(tuple, drawn(1, 2)))) > 2
    assert drawn(1, 2) != drawn(2, 2)


def test_the_root_is_given_to_single_views_and_where_it_is_asked_for() -> None:
    def roots(system: Known, **changes) -> np.ndarray:
        scores = score_set(system, FakeFrames(length=2), replace(QUIET, **changes))
        assert scores.num_samples == 2
        assert scores.num_roots_given == np.isfinite(system.roots).all(-1).sum()
        return np.array(system.roots)

    assert np.isnan(roots(Known())).all()
    for changes in ({"given_root": True}, {"cameras": FixedViews(1)}):
        system = Known()
        given = roots(system, **changes)
        np.testing.assert_allclose(
            given, [one.frame.joints_cam[0, ROOT_JOINT] for one in system.seen], rtol=1e-6
        )
    assert np.isnan(roots(Known(takes_root=False), given_root=True)).all()


def test_one_view_is_no_sample_for_a_system_that_needs_two() -> None:
    with pytest.raises(ValueError, match=r"none of 2 samples of fake train can be used.*needs two"):
        score_set(Known(takes_root=False), FakeFrames(length=2), replace(QUIET, cameras=FixedViews(1)))
    system = Known(takes_root=False, least_views=1)
    assert len(score_set(system, FakeFrames(length=2), replace(QUIET, cameras=FixedViews(1))).keys) == 2


def test_what_is_not_solved_or_cannot_be_read_is_counted_and_in_no_mean() -> None:
    system = Known(unsolved=frozenset({"take/000001"}))
    heard = []
    scores = score_set(system, FakeFrames(length=5, damaged=frozenset({3})), QUIET, heard.append)
    assert len(heard) == 3
    assert scores.keys == ("take/000000", "take/000002", "take/000004")
    assert scores.unsolved == 1
    assert len(scores.left_out) == 1
    assert "3/0.png" in scores.left_out[0]
    nothing = score_set(Known(unsolved=frozenset({"take/000000"})), FakeFrames(length=1), QUIET)
    assert nothing.means == {}
    assert nothing.unsolved == 1


def test_images_count_once_each_where_every_view_is_scored() -> None:
    told = []
    scores = score_set(Known(), FakeFrames(length=2), replace(QUIET, each_view=True), told.append)
    assert scores.keys == tuple(f"take/{i:06d}:{name}" for i in range(2) for name in view_names())
    assert [(one.sample, one.view) for one in told] == [(i, v) for i in range(2) for v in range(3)]
    # One hand in several cameras: the same error in each.
    np.testing.assert_allclose(np.ptp(scores.rows["mpvpe_mm"].reshape(2, 3), axis=1), 0, atol=2e-2)
    frame = FakeFrames()[0]
    np.testing.assert_allclose(told[1].vertices_cam, frame.vertices_cam[1], atol=0.02)
    lost = Known(unsolved=frozenset({"take/000001"}))
    assert score_set(lost, FakeFrames(length=2), replace(QUIET, each_view=True)).unsolved == 3


def view_names() -> tuple[str, ...]:
    return FakeFrames()[0].view_names


def test_vertices_count_only_where_they_are_the_hands_of_the_system() -> None:
    class Another(Known):
        hand = default_hand()._replace(J_regressor=np.roll(default_hand().J_regressor, 100, axis=1))

    scores = score_set(Another(), FakeFrames(length=2), replace(QUIET, protocol="poem-release"))
    assert scores.joints_alone
    assert scores.protocol == "poem"
    assert "mpvpe_mm" not in scores.means
    assert scores.means["mpjpe_mm"] > 0


def test_a_hand_is_known_by_its_regressor() -> None:
    system = Known()
    score_set(system, FakeFrames(length=1), QUIET)
    batch = system.batches[0]
    sample = batch._replace(joints_world=batch.joints_world[0], vertices_world=batch.vertices_world[0])
    assert is_of_hand(default_hand(), sample)
    assert not is_of_hand(default_hand(), sample._replace(vertices_world=sample.vertices_world[::-1]))
    nothing = np.full_like(sample.vertices_world, np.nan)
    assert not is_of_hand(default_hand(), sample._replace(vertices_world=nothing))
    assert not is_of_hand(mirror(default_hand())._replace(J_regressor=0 * default_hand().J_regressor), sample)


def test_errors_of_joints_are_those_of_the_whole_evaluation() -> None:
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 0.05, (3, 21, 3))
    found, mesh = truth + rng.normal(0, 0.01, truth.shape), rng.normal(0, 0.05, (3, 778, 3))
    for protocol in ("poem", "ho3d", "dexycb"):
        alone, whole = (
            evaluate_joints(found, truth, protocol=protocol),
            evaluate(found, truth, mesh, mesh, protocol=protocol),
        )
        assert alone == {name: whole[name] for name in alone}
        assert {"mpjpe_mm", "rr_mpjpe_mm", "pa_mpjpe_mm", "auc_j_20", "pa_auc_j_50"} <= set(alone)
    with pytest.raises(ValueError, match="there are none"):
        evaluate_joints(found, truth, protocol="poem-release")


def test_cameras_are_changed_after_the_samples_are_made() -> None:
    plain, shuffled = Known(), Known()
    score_set(plain, FakeFrames(length=4, views=4), QUIET)
    scores = score_set(shuffled, FakeFrames(length=4, views=4), replace(QUIET, change=shuffle_cameras))
    a, b = (
        np.concatenate([batch.cameras.T_cam_from_world for batch in s.batches]) for s in (plain, shuffled)
    )
    assert not np.allclose(a, b)
    np.testing.assert_allclose(np.sort(a.sum((-1, -2)), -1), np.sort(b.sum((-1, -2)), -1), rtol=1e-5)
    # The truth stays in the world that it was in.
    assert scores.means["mpvpe_mm"] < 5


def test_samples_are_spread_over_the_set() -> None:
    scores = score_set(Known(), FakeFrames(length=9), replace(QUIET, samples=3))
    assert scores.keys == ("take/000000", "take/000004", "take/000008")


def test_models_that_couple_samples_get_them_one_by_one() -> None:
    system = Known(one_at_a_time=True)
    score_set(system, FakeFrames(length=3), QUIET)
    assert [len(batch.views) for batch in system.batches] == [1, 1, 1]


def test_settings_that_cannot_be(micro_model) -> None:
    with pytest.raises(ValueError, match=r"must be at least 1; got 0, 2"):
        replace(QUIET, samples=0)
    with pytest.raises(ValueError, match="`protocol` must be one of"):
        replace(QUIET, protocol="mine")
    config, params = micro_model
    with pytest.raises(ValueError, match="not turned upright"):
        Network(replace(config, crop=replace(config.crop, upright=True)), params)


def test_standard_error_of_known_numbers() -> None:
    assert standard_error(np.array([1.0, 2.0, 3.0])) == pytest.approx(1 / np.sqrt(3))
    assert np.isnan(standard_error(np.array([1.0])))


def test_corrupt_frames_are_not_hidden() -> None:
    class Torn(FakeFrames):
        def __getitem__(self, index):
            raise CorruptSampleError("a.tar", str(index), "torn")

    with pytest.raises(
        ValueError, match=r"none of 2 samples of fake train can be used: a.tar, sample 0: torn"
    ):
        score_set(Known(), Torn(length=2), QUIET)
