import numpy as np
import pytest

from poem_jax.geometry.rig import Rig


@pytest.fixture
def rig(look_at):
    cams = look_at(num_views=3)
    size_wh = np.full((3, 2), (128, 96))
    return Rig(("left", "top", "right"), size_wh, cams.K, np.zeros((3, 5)), cams.T_cam_from_world)


def test_cameras_of_all_views(rig):
    assert rig.num_views == 3
    assert rig.cameras.view_mask.all()
    np.testing.assert_array_equal(rig.cameras.K, rig.K)


def test_select_reorders(rig):
    chosen = rig.select(["right", "left"])
    assert chosen.names == ("right", "left")
    np.testing.assert_array_equal(chosen.T_cam_from_world, rig.T_cam_from_world[[2, 0]])
    assert rig.select([]).num_views == 0


def test_unknown_camera(rig):
    with pytest.raises(ValueError, match=r"cameras must be among \['left', 'top', 'right'\]; got \['back'\]"):
        rig.select(["left", "back"])
