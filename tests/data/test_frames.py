"""What a frame must be before anybody trains on it."""

import pickle

import numpy as np
import pytest

from poem_jax.data.frames import CorruptSampleError, check_frame
from tests.data.one_frame import one_frame

PATH = "shards/DexYCB_mv_train-000000.tar"


@pytest.fixture(scope="module")
def frame():
    frame = one_frame()
    return frame._replace(box_px=np.concatenate([frame.keypoints_px.min(1), frame.keypoints_px.max(1)], -1))


def changed(frame, name, view, change):
    value = getattr(frame, name).copy()
    value[view] = change(value[view])
    return frame._replace(**{name: value})


def test_a_true_frame_passes_as_it_is(frame):
    assert check_frame(frame, PATH) is frame


def _about_its_middle(points, factor):
    return points.mean(0) + factor * (points - points.mean(0)) + [0, 0, 5]


def _not_finite(values):
    values = np.array(values, float)
    values.reshape(-1)[0] = np.nan
    return values


FAULTS = {
    "a hand 3 m wide": ("joints_cam", lambda x: _about_its_middle(x, 15), "`joints_cam` is a hand of"),
    "vertices 3 m wide": ("vertices_cam", lambda x: _about_its_middle(x, 15), "`vertices_cam` is a hand of"),
    "a hand in millimetres": ("joints_cam", lambda x: 1000 * x, "`joints_cam` is a hand of"),
    "a hand of a fly": ("joints_cam", lambda x: x[:1] + 0.05 * (x - x[:1]), "`joints_cam` is a hand of"),
    "joints behind the camera": ("joints_cam", lambda x: x - [0, 0, 3], "`joints_cam` lies -"),
    "vertices behind the camera": ("vertices_cam", lambda x: x - [0, 0, 3], "`vertices_cam` lies -"),
    "a hand on the moon": ("joints_cam", lambda x: x + np.array([0, 0, 1e6]), "`joints_cam` lies 1e"),
    "NaN joints": ("joints_cam", _not_finite, "`joints_cam` is not finite"),
    "NaN pose": ("pose_cam", _not_finite, "`pose_cam` is not finite"),
    "NaN pixels": ("keypoints_px", _not_finite, "`keypoints_px` is not finite"),
    "infinite shape": ("shape", lambda x: x + np.inf, "`shape` is not finite"),
    "a stretched extrinsic": ("T_cam_from_world", lambda T: T * [[1.1], [1], [1], [1]], "is not rigid"),
    "a mirrored extrinsic": ("T_cam_from_world", lambda T: T * [[-1], [1], [1], [1]], "is not rigid"),
    "a transposed extrinsic": ("T_cam_from_world", lambda T: T.T, "is not rigid"),
    "a negative focal length": ("K", lambda K: K * [[-1], [1], [1]], "K is not"),
    "a transposed K": ("K", lambda K: K.T, "K is not"),
    "a box from right to left": ("box_px", lambda box: box[[2, 1, 0, 3]], "`box_px` is not x0 y0 x1 y1"),
    "a box from below": ("box_px", lambda box: box[[0, 3, 2, 1]], "`box_px` is not x0 y0 x1 y1"),
    "an empty box": ("box_px", lambda box: box[[0, 1, 0, 3]], "`box_px` is not x0 y0 x1 y1"),
}


@pytest.mark.parametrize("view", [0, 2])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_one_view_is_named_with_path_key_and_view(frame, fault, view):
    name, change, words = FAULTS[fault]
    with pytest.raises(CorruptSampleError) as caught:
        check_frame(changed(frame, name, view, change), PATH)
    message = str(caught.value)
    assert message.startswith(f"{PATH}, sample take/000001: ")
    assert words in message
    assert f"view cam{view}" in message
    assert all(f"cam{other}" not in message for other in {0, 1, 2} - {view})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"images": ()}, "no image"),
        ({"joints_cam": np.zeros((3, 20, 3))}, r"`joints_cam` must have shape \(3, 21, 3\) for 3 images"),
        ({"K": np.zeros((2, 3, 3))}, r"`K` must have shape \(3, 3, 3\) for 3 images; got \(2, 3, 3\)"),
        ({"mirror_px": np.zeros((3, 1))}, r"`mirror_px` must have shape \(3,\)"),
        ({"view_names": ("a", "b")}, "2 names of views for 3 images"),
    ],
)
def test_wrong_shapes_are_named(frame, change, words):
    with pytest.raises(CorruptSampleError, match=words):
        check_frame(frame._replace(**change), PATH)


def test_the_error_survives_the_way_from_a_worker_process():
    error = pickle.loads(pickle.dumps(CorruptSampleError("a.tar", "0001", "no label")))
    assert (error.path, error.key, error.problem) == ("a.tar", "0001", "no label")
    assert str(error) == "a.tar, sample 0001: no label"
