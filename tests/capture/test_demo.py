"""The take that ships: videos, calibration and truth belong together, and the score means what it says."""

import cv2
import numpy as np
import pytest

from poem_jax.capture.demo import demo_folder, demo_score, demo_truth
from poem_jax.capture.moments import find_moments
from poem_jax.data.capture_folder import find_rig
from poem_jax.synthetic.desk.cameras import FRAMES_PER_SECOND, NUM_FRAMES, SIZE_WH, desk_rig, frame_times
from poem_jax.synthetic.desk.motion import SIDES, hands_at

REMAKE = "the hand, the motion or the cameras have changed: run tools/make_demo.py"


def test_the_calibration_is_that_of_the_cameras():
    rig, drawn = find_rig(demo_folder()), desk_rig()
    assert rig.names == drawn.names
    for name in ("size_wh", "K", "T_cam_from_world"):
        np.testing.assert_allclose(getattr(rig, name), getattr(drawn, name), atol=1e-6, err_msg=REMAKE)
    terms = drawn.dist.shape[1]
    np.testing.assert_allclose(rig.dist[:, :terms], drawn.dist, atol=1e-9, err_msg=REMAKE)
    assert not rig.dist[:, terms:].any()


def test_the_truth_is_that_of_the_motion():
    truth = demo_truth()
    assert truth.sides == SIDES
    assert len(truth.vertices_world) == NUM_FRAMES
    for frame in (0, 17, NUM_FRAMES - 1):
        hands = hands_at(frame_times()[frame])
        np.testing.assert_allclose(
            truth.vertices_world[frame], hands.vertices_world, atol=1e-6, err_msg=REMAKE
        )
        np.testing.assert_allclose(truth.joints_world[frame], hands.joints_world, atol=1e-6, err_msg=REMAKE)


def test_the_videos_are_small_and_whole():
    videos = sorted(demo_folder().glob("*.mp4"))
    assert [video.stem for video in videos] == list(desk_rig().names)
    assert sum(video.stat().st_size for video in videos) < 3e6
    for video in videos:
        reader, frames = cv2.VideoCapture(str(video)), 0
        while reader.grab():
            frames += 1
        assert frames == NUM_FRAMES
        assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(FRAMES_PER_SECOND)
        assert (reader.get(cv2.CAP_PROP_FRAME_WIDTH), reader.get(cv2.CAP_PROP_FRAME_HEIGHT)) == SIZE_WH
    moments = find_moments(demo_folder(), find_rig(demo_folder()))
    assert len(moments.frames) == NUM_FRAMES


def test_the_score_is_the_mean_distance_of_the_hands_that_were_found():
    truth = demo_truth()
    arrays = {"vertices_world": truth.vertices_world.copy(), "joints_world": truth.joints_world.copy()}
    exact = demo_score(arrays, truth.sides)
    assert exact.mpvpe_mm == pytest.approx(0, abs=1e-6)
    assert exact.found == exact.of == 2 * NUM_FRAMES

    shifted = {name: array + np.array([0.003, 0, 0.004], np.float32) for name, array in arrays.items()}
    shifted["vertices_world"][5:, 1] = np.nan
    turned = {name: array[:, ::-1] for name, array in shifted.items()}
    for hands, names in ((shifted, truth.sides), (turned, truth.sides[::-1])):
        score = demo_score(hands, names)
        assert score.mpvpe_mm == pytest.approx(5, abs=1e-3)
        assert (score.found, score.of) == (NUM_FRAMES + 5, 2 * NUM_FRAMES)

    with pytest.raises(ValueError, match="none of the demo's hands was found"):
        demo_score({name: np.full_like(array, np.nan) for name, array in arrays.items()}, truth.sides)


@pytest.mark.slow
def test_the_videos_show_what_is_drawn():
    from poem_jax.synthetic.desk.take import desk_pictures

    (picture,) = desk_pictures(0, (1,))
    _, shown = cv2.VideoCapture(str(demo_folder() / "cam_1.mp4")).read()
    assert np.abs(shown[..., ::-1].astype(float) - picture.image).mean() < 5, REMAKE
