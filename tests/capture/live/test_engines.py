"""The engines of the live line on planted hands."""

from dataclasses import replace

import numpy as np
import pytest

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.capture.boxes_file import boxes_from_keypoints
from poem_jax.capture.fit import fit_config
from poem_jax.capture.frame import Frame
from poem_jax.capture.live.engines import MOMENTS_FOR_SHAPE, live_fit
from poem_jax.fitting import Observations, fit_take, keypoint_model
from poem_jax.fitting.lm import ShapeMode
from poem_jax.hand.pair import hands_of
from poem_jax.hand.template import default_hand
from tests.capture.live.fake_cameras import RIG, SIDES, seen_hands, true_joints


def frame_at(number, time_s, sides=SIDES):
    keypoints = np.full((2, RIG.num_views, 21, 2), np.nan)
    for view in range(RIG.num_views):
        for hand in seen_hands(view, true_joints(time_s)):
            if hand.side in sides:
                keypoints[SIDES.index(hand.side), view] = hand.keypoints_px
    noise = np.random.default_rng(number).normal(0, 0.5, keypoints.shape)
    boxes = boxes_from_keypoints(keypoints)
    return Frame(f"{number:06d}", boxes, keypoints + noise, np.ones(keypoints.shape[:-1]), time_s=time_s)


@pytest.mark.slow
def test_once_the_shape_is_known_each_moment_is_the_fit_of_itself():
    hands = hands_of(default_hand())
    engine = live_fit(RIG, hands, detector=None)
    engine.compile()
    frames = [frame_at(i, 0.21 * i) for i in range(MOMENTS_FOR_SHAPE + 3)]
    frames.append(frame_at(len(frames), 0.21 * len(frames), ("left",)))
    done = list(engine.run(iter(frames)))
    shapes = np.stack([frame.hands[1].shape for frame in done])
    assert len(np.unique(shapes, axis=0)) == 3, "found with 1, 4 and 16 moments"
    np.testing.assert_array_equal(shapes[MOMENTS_FOR_SHAPE - 1 :], shapes[[-1]].repeat(5, axis=0))
    for frame in done[:-1]:
        for hand, truth in zip(frame.hands, true_joints(frame.time_s), strict=True):
            assert np.linalg.norm(hand.joints_world - truth, axis=-1).mean() < 0.004
    config = fit_config(RIG, smooth=False)
    config = replace(config, lm=replace(config.lm, shape_mode=ShapeMode.GIVEN))
    for frame in done[-3:-1]:
        keypoints = ideal_keypoints(RIG, frame.keypoints_px[None])
        for index, side in enumerate(SIDES):
            seen = Observations(
                keypoints[:, index], frame.confidence[None, index], RIG.K, RIG.T_cam_from_world
            )
            alone = fit_take(keypoint_model(hands.of(side)), seen, frame.hands[index].shape, config)
            np.testing.assert_allclose(frame.hands[index].joints_world, alone.joints[0], atol=1e-6)
    assert done[-1].hands[0].reason == "seen in 0 view(s); two are needed"
    assert done[-1].hands[1].reason is None
