"""A miniature capture is read back as it was planted."""

import numpy as np

from poem_jax.data.sources.captures import Captures
from poem_jax.geometry.transforms import invert_rigid
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.miniatures import captures

METRES, PIXELS = 1e-5, 0.01


def test_a_capture_is_read_back(tmp_path):
    planted = captures.write(tmp_path / "desk", frames=2)
    source = Captures(tmp_path / "desk")
    assert len(source) == len(planted)
    for frame, read in zip(planted, (source[i] for i in range(len(source))), strict=True):
        assert read.key == f"desk/{frame.key_hint}/right"
        views = [frame.view_names.index(name) for name in read.view_names]
        assert len(views) >= 2
        np.testing.assert_allclose(read.joints_cam, frame.joints_cam[views], atol=METRES)
        np.testing.assert_allclose(read.vertices_cam, frame.vertices_cam[views], atol=METRES)
        np.testing.assert_allclose(read.keypoints_px, frame.keypoints_px[views], atol=PIXELS)
        moved = read.T_cam_from_world @ invert_rigid(frame.T_cam_from_world[views])
        np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=METRES)
        mesh = hand_mesh(default_hand(), read.pose_cam[0], read.shape[0])
        offset = read.vertices_cam[0] - mesh.vertices
        np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-4)
