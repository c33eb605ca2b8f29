"""The file of HO-3D's official evaluation: its order, axes and layout."""

import json
import zipfile

import numpy as np
import pytest

from poem_jax.evaluation.ho3d_submission import Ho3dSubmission

WRIST, INDEX_TIP, THUMB_BASE = 0, 8, 1
"""In OpenPose's order."""


def test_rows_axes_and_joints_are_the_sets(tmp_path) -> None:
    hands = Ho3dSubmission(3)
    rng = np.random.default_rng(0)
    joints, vertices = rng.normal(size=(3, 21, 3)), rng.normal(size=(3, 778, 3))
    for row in (2, 0):
        hands.add(row, joints[row], vertices[row])
    assert list(hands.missing) == [1]
    with pytest.raises(ValueError, match=r"each of 3 images, and 1 have none; the first is line 2"):
        hands.write(tmp_path / "x.zip")
    assert not list(tmp_path.iterdir())
    hands.add(1, joints[1], vertices[1])
    hands.write(tmp_path / "x.zip")
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        assert archive.namelist() == ["pred.json"]
        xyz, verts = (np.array(part) for part in json.loads(archive.read("pred.json")))
    opengl = [1, -1, -1]
    np.testing.assert_allclose(verts, vertices * opengl, atol=1e-6)
    np.testing.assert_allclose(xyz[:, 0], joints[:, WRIST] * opengl, atol=1e-6)
    # MANO's order: wrist, index, middle, little, ring, thumb; then the tips from the thumb on.
    np.testing.assert_allclose(xyz[:, 13], joints[:, THUMB_BASE] * opengl, atol=1e-6)
    np.testing.assert_allclose(xyz[:, 17], joints[:, INDEX_TIP] * opengl, atol=1e-6)
