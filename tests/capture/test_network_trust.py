"""What a network lets see of its doubts: laws of the standard deviation and of the confidence."""

import numpy as np
import pytest

from poem_jax.batch import Prediction
from poem_jax.capture.frame import HandCrops
from poem_jax.capture.network_trust import SHIPPED, Doubts, doubts_of, joint_confidence, joint_sigma
from poem_jax.fitting.robust_weight import agreement
from poem_jax.geometry.cameras import project
from poem_jax.hand.topology import NUM_JOINTS, QueryOrder, join_queries
from tests.rigs import small_rig

SIDE, CELLS, ORDER = 128, 32, QueryOrder.VERTICES_FIRST


def maps_at(points_px, spread_px):
    """Normal heat maps about points (view, joint, 2) of a crop."""
    centres = (np.arange(CELLS) + 0.5) * SIDE / CELLS
    along = np.exp(-(((points_px[..., None] - centres) / spread_px) ** 2) / 2)
    maps = along[..., 1, :, None] * along[..., 0, None, :]
    return maps / maps.sum((-2, -1), keepdims=True)


def example(spread_px=6.0, steps_m=(0.002,), views=3, off_px=0.0):
    """A prediction that agrees with its heat maps but for `off_px` to the right, and its crops."""
    rig = small_rig()
    joints = np.random.default_rng(0).uniform(-0.04, 0.04, (NUM_JOINTS, 3))
    K = rig.K.copy()
    K[:, :2] *= 0.5
    mask = np.arange(3) < views
    crops = HandCrops(np.zeros((3, SIDE, SIDE, 3), np.uint8), K, rig.T_cam_from_world, mask)
    points_px, _ = project(crops.K, crops.T_cam_from_world, joints)
    points_px = points_px + np.array([off_px, 0.0])
    layers = [joints + np.array([step, 0, 0]) for step in (*steps_m, 0.0)]
    queries = np.stack([join_queries(np.zeros((778, 3)), layer, ORDER) for layer in layers])
    maps = maps_at(points_px, spread_px)
    return Prediction(np.zeros((778, 3)), joints, joints[9], points_px, queries, np.array(True), maps), crops


def test_the_signs_are_in_metres_and_shares_of_the_crop():
    found, crops = example()
    doubts = doubts_of(found, crops, ORDER)
    # One layer before the last, 2 mm along one of three axes.
    np.testing.assert_allclose(doubts.layers_m, 0.002 / np.sqrt(3), rtol=1e-6)
    np.testing.assert_allclose(doubts.spread_share, 6 / SIDE, rtol=0.02)
    np.testing.assert_allclose(doubts.off_share, 0, atol=1e-6)
    # Three views some 0.7 m away with a focal length of 105 px.
    assert (doubts.rays_m > 0.6 / 105 * 6 / np.sqrt(3) * 0.7).all()
    assert (doubts.rays_m < 0.9 / 105 * 6 / np.sqrt(3) * 1.3).all()


def test_the_standard_deviation_grows_with_every_sign_of_doubt():
    least = joint_sigma(doubts_of(*example(), ORDER), SHIPPED)
    for more in ({"spread_px": 12.0}, {"steps_m": (0.01,)}, {"views": 2}, {"off_px": 10.0}):
        assert (joint_sigma(doubts_of(*example(**more), ORDER), SHIPPED) > least).all(), more


def test_confidence_falls_with_spread_and_distance_and_is_nan_where_nothing_is_seen():
    def of(**options):
        return joint_confidence(doubts_of(*example(**options), ORDER), SHIPPED)

    sharp = of(spread_px=0.5 * SHIPPED.sharp_share * SIDE)
    np.testing.assert_allclose(sharp, 1, atol=1e-6)
    wide = of(spread_px=2 * SHIPPED.sharp_share * SIDE)
    np.testing.assert_allclose(np.median(wide), 0.25, atol=0.02)
    far = of(spread_px=0.5 * SHIPPED.sharp_share * SIDE, off_px=20.0)
    assert (far < 0.7).all()
    unseen = of(views=2)
    assert np.isnan(unseen[2]).all()
    assert np.isfinite(unseen[:2]).all()


def test_a_model_with_the_roots_heat_map_alone_trusts_all_joints_as_the_root():
    found, crops = example()
    root = found._replace(keypoints_px=found.keypoints_px[:, [9]], heat_maps=found.heat_maps[:, [9]])
    every, one = (doubts_of(each, crops, ORDER) for each in (found, root))
    np.testing.assert_allclose(one.spread_share, np.tile(every.spread_share[:, [9]], (1, NUM_JOINTS)))
    assert joint_confidence(one, SHIPPED).shape == (3, NUM_JOINTS)


def test_a_model_without_heat_maps_has_its_layers_alone():
    found, crops = example()
    doubts = doubts_of(found._replace(keypoints_px=None, heat_maps=None), crops, ORDER)
    assert joint_confidence(doubts, SHIPPED) is None
    np.testing.assert_allclose(joint_sigma(doubts, SHIPPED), SHIPPED.of_layers * doubts.layers_m)
    last = found._replace(keypoints_px=None, heat_maps=None, layers_world=found.layers_world[-1:])
    assert joint_sigma(doubts_of(last, crops, ORDER), SHIPPED) is None


def test_the_order_of_the_views_is_of_no_account():
    found, crops = example(off_px=3.0)
    turned = found._replace(keypoints_px=found.keypoints_px[::-1], heat_maps=found.heat_maps[::-1])
    fed = HandCrops(*(array[::-1] for array in crops))
    one, other = doubts_of(found, crops, ORDER), doubts_of(turned, fed, ORDER)
    np.testing.assert_allclose(joint_sigma(one, SHIPPED), joint_sigma(other, SHIPPED))
    np.testing.assert_allclose(joint_confidence(one, SHIPPED), joint_confidence(other, SHIPPED)[::-1])


@pytest.mark.parametrize(("sigmas", "weight"), [(0.0, 1.0), (1.163, 0.9), (3.218, 0.5), (7.352, 0.1)])
def test_what_a_weight_means(sigmas, weight):
    assert agreement(np.array(sigmas * 0.3), 0.3) == pytest.approx(weight, abs=1e-3)


def test_one_doubt_is_for_one_joint():
    found, crops = example()
    doubts = doubts_of(found, crops, ORDER)
    moved = Doubts(np.where(np.arange(21) == 4, 0.03, doubts.layers_m), *doubts[1:])
    changed = joint_sigma(moved, SHIPPED) != joint_sigma(doubts, SHIPPED)
    assert changed.tolist() == [joint == 4 for joint in range(21)]
