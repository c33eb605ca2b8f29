"""What a reader must find of a frame that a miniature shows."""

import numpy as np

from poem_jax.data.frames import MultiViewFrame
from poem_jax.miniatures.scene import PlantedFrame


def assert_planted(frame: MultiViewFrame, planted: PlantedFrame) -> None:
    """Insist on 1e-5 m and 0.01 px, for the views that the frame has, by name."""
    views = [planted.view_names.index(name) for name in frame.view_names]
    assert planted.key_hint in frame.key
    np.testing.assert_array_equal(frame.size_wh, planted.size_wh[views])
    np.testing.assert_allclose(frame.K, planted.K[views], atol=1e-3)
    np.testing.assert_allclose(frame.joints_cam, planted.joints_cam[views], atol=1e-5)
    np.testing.assert_allclose(frame.vertices_cam, planted.vertices_cam[views], atol=1e-5)
    np.testing.assert_allclose(frame.keypoints_px, planted.keypoints_px[views], atol=0.01)
    np.testing.assert_allclose(frame.pose_cam, planted.pose_cam[views], atol=1e-4)
    np.testing.assert_allclose(frame.shape, np.tile(planted.shape, (len(views), 1)), atol=1e-5)
    relative = frame.T_cam_from_world @ np.linalg.inv(frame.T_cam_from_world[0])
    expected = planted.T_cam_from_world[views] @ np.linalg.inv(planted.T_cam_from_world[views[0]])
    np.testing.assert_allclose(relative, expected, atol=1e-5)
