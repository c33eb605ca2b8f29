import numpy as np
import pytest

from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.geometry.world_origin import FAR_M, distant_origin, move_origin

K = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
FAR = np.array([500e3, 4500e3, 300.0])


def rig(centre) -> np.ndarray:
    """Three cameras within a metre of `centre`."""
    rng = np.random.default_rng(0)
    R = rotation_from_axis_angle(rng.normal(size=(3, 3)))
    centres = np.asarray(centre) + rng.uniform(-1, 1, (3, 3))
    return rigid(R, -np.einsum("vij,vj->vi", R, centres))


def test_moved_cameras_see_moved_points_where_they_were():
    T, points = rig(FAR), FAR + np.random.default_rng(1).normal(size=(3, 5, 3))
    origin = distant_origin(T)
    assert np.linalg.norm(origin - FAR) < 3
    before, _ = project(K[None], T, points)
    after, _ = project(K[None], move_origin(T, origin), points - origin)
    np.testing.assert_allclose(after, before, rtol=1e-6)


def test_rounding_a_far_world_shifts_the_pixels_and_a_moved_one_does_not():
    T, points = rig(FAR), FAR + np.array([0.1, 0.2, 3.0])
    points = np.broadcast_to(points, (3, 1, 3))
    origin = distant_origin(T)
    pixels, _ = project(K[None], T, points)
    rounded = [
        project(K[None].astype(np.float32), t.astype(np.float32), p.astype(np.float32))[0]
        for t, p in ((T, points), (move_origin(T, origin), points - origin))
    ]
    assert np.abs(rounded[0] - pixels).max() > 10
    assert np.abs(rounded[1] - pixels).max() < 0.02


def test_ordinary_worlds_stay_as_they_are():
    assert not distant_origin(rig([0.5 * FAR_M, 0, 0]).astype(np.float32)).any()
    unknown = rig(FAR)
    unknown[:] = np.nan
    assert not distant_origin(unknown).any()


def test_an_unknown_camera_does_not_hide_that_the_others_are_far():
    T = rig(FAR)
    T[0] = np.nan
    assert np.linalg.norm(distant_origin(T) - FAR) < 3


def test_extrinsics_that_were_rounded_are_refused():
    with pytest.raises(ValueError, match=r"world's origin.*must be float64.*got float32"):
        distant_origin(rig(FAR).astype(np.float32))
