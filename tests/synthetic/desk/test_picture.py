"""Pictures of the desk: the truth lies on what is drawn, what is nearer hides what is farther."""

import numpy as np
import pytest

from poem_jax.data.lens import project_raw
from poem_jax.hand.template import default_hand
from poem_jax.render.zbuffer import rasterise
from poem_jax.synthetic.desk.body import body_surface
from poem_jax.synthetic.desk.cameras import SIZE_WH, desk_rig, frame_times
from poem_jax.synthetic.desk.motion import SIDES, hands_at
from poem_jax.synthetic.desk.picture import SUPERSAMPLE, through_lens
from poem_jax.synthetic.desk.take import desk_pictures

FRAME = 15
VIEWS = (2, 3)


@pytest.fixture(scope="module")
def pictures():
    return desk_pictures(FRAME, VIEWS)


@pytest.fixture(scope="module")
def true_depths():
    """Depth (view, hand, fine_h, fine_w) of each true hand alone, by another way through the lens."""
    rig, hands = desk_rig(), hands_at(frame_times()[FRAME])
    hw = (SIZE_WH[1] * SUPERSAMPLE, SIZE_WH[0] * SUPERSAMPLE)

    def depth(view, side, vertices):
        pixels, points_cam = project_raw(rig, view, vertices)
        seen = np.column_stack([SUPERSAMPLE * pixels, points_cam[:, 2]])
        return rasterise(seen, default_hand(side).faces, hw).depth

    return np.array(
        [[depth(view, *hand) for hand in zip(SIDES, hands.vertices_world, strict=True)] for view in VIEWS]
    )


def test_surfaces_go_through_the_lens_that_the_calibration_tells():
    rig, scene = desk_rig(), body_surface(hands_at(0.0))
    for view in range(rig.num_views):
        seen = through_lens(scene, rig, view)
        pixels, points_cam = project_raw(rig, view, scene.vertices)
        drawn = seen[:, 2] > 0
        assert drawn.mean() > 0.9
        np.testing.assert_allclose(seen[drawn, :2] / SUPERSAMPLE, pixels[drawn], atol=1e-6)
        np.testing.assert_allclose(seen[drawn, 2], points_cam[drawn, 2], atol=1e-9)


def test_the_true_hands_are_what_is_drawn(pictures, true_depths):
    for picture, hands in zip(pictures, true_depths, strict=True):
        nearest = hands.min(0)
        shown = np.isfinite(nearest)
        behind = picture.depth[shown] - nearest[shown]
        # Fine faces bulge over coarse ones, and beside a coarse edge there is what lies behind it.
        assert np.mean(np.abs(behind) < 0.0025) > 0.93
        assert np.mean(behind > 0.004) < 0.01


def test_the_nearer_hand_hides_the_other(pictures, true_depths):
    both = np.isfinite(true_depths).all(1)
    assert both.sum() > 500, "choose a frame in which one hand is seen before the other"
    for picture, hands, overlap in zip(pictures, true_depths, both, strict=True):
        if overlap.any():
            assert np.mean(picture.depth[overlap] < hands.min(0)[overlap] + 0.003) > 0.98


def test_pictures_are_the_same_on_every_run(pictures):
    again = desk_pictures(FRAME, VIEWS[:1])[0]
    np.testing.assert_array_equal(again.image, pictures[0].image)
    assert again.image.std() > 20
