"""Numbers of a frame that do not fit each other are refused, and what true data are off by is not."""

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError, check_frame
from poem_jax.data.sources.released_tars import ReleasedTars
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle
from tests.data.one_frame import one_frame
from tests.data.released_labels import released_label, write_label

PATH = "a.tar"


@pytest.fixture(scope="module")
def frame():
    return one_frame()


def in_view(array, view, change):
    array = array.copy()
    array[view] = change(array[view])
    return array


LIES = {
    "extrinsics the other way": (
        lambda f: f._replace(T_cam_from_world=invert_rigid(f.T_cam_from_world)),
        r"put the hand to places .* m apart",
    ),
    "one extrinsic of another moment": (
        lambda f: f._replace(T_cam_from_world=f.T_cam_from_world[[1, 1, 2]]),
        r"views cam0 and cam\d put the hand to places",
    ),
    "K of another image size": (
        lambda f: f._replace(K=f.K * [[[2.0], [2.0], [1.0]]]),
        r"projected by K are .* px from `keypoints_px` \(median\) in view cam0",
    ),
    "key points of another view": (
        lambda f: f._replace(keypoints_px=in_view(f.keypoints_px, 1, lambda x: x + 60)),
        r"projected by K .* in view cam1; expected at most",
    ),
    "key points in one place": (
        lambda f: f._replace(keypoints_px=in_view(f.keypoints_px, 2, lambda x: 0 * x)),
        r"`keypoints_px` are within 0 px of each other in view cam2",
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_what_does_not_fit_is_named(frame, lie):
    change, words = LIES[lie]
    with pytest.raises(CorruptSampleError, match=rf"a\.tar, sample take/000001: .*{words}"):
        check_frame(change(frame), PATH)


def test_what_calibrations_and_annotators_are_off_by_passes(frame):
    """Two degrees and 2 cm between cameras, 5 pixels in the key points."""
    rng = np.random.default_rng(0)
    error = rigid(
        rotation_from_axis_angle(rng.uniform(-0.02, 0.02, (3, 3))), rng.uniform(-0.02, 0.02, (3, 3))
    )
    off = frame._replace(
        T_cam_from_world=error @ frame.T_cam_from_world,
        keypoints_px=frame.keypoints_px + rng.normal(0, 5, frame.keypoints_px.shape),
    )
    assert check_frame(off, PATH) is off


def test_a_tar_under_another_sets_name_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    label = released_label(one_frame(skew=0.0), world_to_camera=False)
    write_label(tmp_path / "DexYCB_mv_test-000000.tar", label)
    assert ReleasedTars(tmp_path)[0].key
    (tmp_path / "DexYCB_mv_test-000000.tar").rename(tmp_path / "Oakink_mv_test-000000.tar")
    with pytest.raises(
        CorruptSampleError, match=r"Oakink_mv_test-000000\.tar.*the extrinsics map the other way"
    ):
        ReleasedTars(tmp_path)[0]
