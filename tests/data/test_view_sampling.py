"""Rules for views, by counting what they draw."""

from collections import Counter

import numpy as np
import pytest

from poem_jax.data.view_sampling import (
    AllViews,
    FixedViews,
    ReleaseNormalViews,
    UniformViews,
    cameras_in_words,
    cameras_named,
)

RANDOM = [UniformViews(), UniformViews(2, 5), ReleaseNormalViews(1, 8), ReleaseNormalViews(2, 3)]


def draws(rule, num_views: int, count: int = 6000, most: int | None = None) -> list[list[int]]:
    rng = np.random.default_rng(0)
    return [rule.draw(num_views, rng, most).tolist() for _ in range(count)]


@pytest.mark.parametrize("rule", [*RANDOM, AllViews(), FixedViews(3)])
@pytest.mark.parametrize("num_views", [1, 4, 8])
def test_views_are_drawn_at_most_once(rule, num_views):
    for views in draws(rule, num_views, 100):
        assert 1 <= len(set(views)) == len(views) <= num_views
        assert set(views) <= set(range(num_views))


@pytest.mark.parametrize("rule", RANDOM)
def test_every_view_is_first_as_often(rule):
    firsts = Counter(views[0] for views in draws(rule, 5))
    assert len(firsts) == 5
    assert all(abs(n - 1200) < 150 for n in firsts.values())


@pytest.mark.parametrize(
    ("rule", "num_views", "counts"),
    [
        (UniformViews(), 8, range(1, 9)),
        (UniformViews(2, 5), 8, range(2, 6)),
        (UniformViews(1, 8), 4, range(1, 5)),
        (UniformViews(3, 4), 2, [2]),
    ],
)
def test_the_papers_numbers_of_views_are_uniform(rule, num_views, counts):
    found = Counter(len(views) for views in draws(rule, num_views))
    assert sorted(found) == list(counts)
    assert all(abs(n - 6000 / len(found)) < 150 for n in found.values())


@pytest.mark.parametrize(
    ("rule", "counts"),
    [(UniformViews(), [1, 2, 3, 4]), (UniformViews(2, 6), [2, 3, 4]), (UniformViews(6), [4])],
)
def test_numbers_of_views_are_as_uniform_where_there_is_room_for_fewer(rule, counts):
    found = Counter(len(views) for views in draws(rule, 8, most=4))
    assert sorted(found) == counts
    assert all(abs(n - 6000 / len(found)) < 150 for n in found.values())
    assert {view for views in draws(rule, 8, 200, most=4) for view in views} == set(range(8))


@pytest.mark.parametrize(
    "rule", [ReleaseNormalViews(1, 8), ReleaseNormalViews(6, 8), AllViews(), FixedViews(5)]
)
def test_other_rules_are_cut_to_the_room_there_is(rule):
    cut, whole = draws(rule, 6, 200, most=3), draws(rule, 6, 200)
    assert cut == [views[:3] for views in whole]


def test_the_releases_numbers_of_views_are_a_rounded_normal():
    share = {n: k / 6000 for n, k in Counter(len(v) for v in draws(ReleaseNormalViews(1, 8), 8)).items()}
    # N(4, 2) within half a view of each number; below 1.5 and above 7.5 at the ends.
    expected = {1: 0.1056, 2: 0.1210, 3: 0.1747, 4: 0.1974, 5: 0.1747, 6: 0.1210, 7: 0.0655, 8: 0.0401}
    for number, p in expected.items():
        assert abs(share[number] - p) < 0.02, number


def test_the_range_is_held_before_what_there_is():
    assert {len(views) for views in draws(ReleaseNormalViews(6, 8), 4, 50)} == {4}
    assert {len(views) for views in draws(ReleaseNormalViews(3, 3), 8, 50)} == {3}


def test_fixed_rules_keep_the_frames_order():
    assert draws(AllViews(), 5, 1) == [[0, 1, 2, 3, 4]]
    assert draws(FixedViews(2), 5, 1) == [[0, 1]]
    assert draws(FixedViews(7), 5, 1) == [[0, 1, 2, 3, 4]]


@pytest.mark.parametrize("rule", [UniformViews, ReleaseNormalViews])
@pytest.mark.parametrize("bounds", [(0, 3), (3, 2)])
def test_ranges_without_views_are_refused(rule, bounds):
    with pytest.raises(ValueError, match=f"got {bounds[0]} to {bounds[1]}"):
        rule(*bounds)


@pytest.mark.parametrize(
    ("text", "counts", "words"),
    [
        ("all", {6}, "all"),
        ("4", {4}, "the first 4"),
        ("random", {6}, "all, in random order"),
        ("random:4", {4}, "4 at random"),
        ("random:2-5", {2, 3, 4, 5}, "2 to 5 at random"),
    ],
)
def test_rules_have_names_and_words(text, counts, words):
    rule = cameras_named(text)
    drawn = draws(rule, 6, 200)
    assert {len(views) for views in drawn} == counts
    assert (len({tuple(views) for views in drawn}) > 1) == text.startswith("random")
    assert cameras_in_words(rule) == words


@pytest.mark.parametrize("text", ["", "two", "random:", "2-8", "random:2-", "-1"])
def test_a_name_that_is_no_rule_is_refused(text):
    with pytest.raises(ValueError, match="cameras are `all`"):
        cameras_named(text)
