import numpy as np
import pytest

from poem_jax.hand import default_hand
from poem_jax.hand.topology import NUM_VERTICES, TIP_VERTICES_LAYER
from poem_jax.synthetic.scene import prepare_hand
from poem_jax.synthetic.skin import skin_colors


@pytest.fixture(scope="module")
def prepared():
    return prepare_hand(default_hand())


def test_every_finger_has_a_nail_on_its_back(prepared):
    skin = prepared.skin
    nails = np.flatnonzero(skin.nail)
    tips = np.asarray(default_hand().v_template)[list(TIP_VERTICES_LAYER)]
    nearest = np.linalg.norm(skin.rest[nails, None] - tips, axis=-1).argmin(1)
    assert set(nearest) == set(range(5))
    assert np.linalg.norm(skin.rest[nails, None] - tips, axis=-1).min(1).max() < 0.03
    assert skin.palm[nails].max() < 0.5


def test_a_left_hand_has_the_same_skin(prepared):
    """But for the middle finger, whose tip is another vertex on a left hand."""
    left = prepare_hand(default_hand("left")).skin
    for name in ("nail", "crease", "red", "palm"):
        gap = np.abs(getattr(left, name) - getattr(prepared.skin, name))
        assert gap.mean() < 0.01


def test_people_differ_and_colours_are_possible(prepared):
    rest = np.concatenate([prepared.skin.rest, prepared.skin.rest[:30] + 0.1])
    people = np.stack([skin_colors(prepared.skin, rest, np.random.default_rng(i)) for i in range(40)])
    assert people.shape == (40, NUM_VERTICES + 30, 3)
    assert people.min() >= 0
    assert people.max() <= 1
    brightness = people.mean((1, 2))
    assert brightness.max() > 4 * brightness.min()
    assert people.std(1).mean() > 0.005
