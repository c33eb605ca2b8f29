"""The parameters give the meshes again, by the rule of the library that they are for."""

import numpy as np
import pytest

from poem_jax.capture.outputs.mano import write_mano
from poem_jax.hand.conventions import from_smplx, to_smplx
from poem_jax.hand.model import hand_mesh
from tests.capture.outputs.conftest import HANDS


@pytest.mark.parametrize("far", [False, True])
def test_the_meshes_come_back(planted, tmp_path, far):
    take = planted(far=far)
    given = {
        side: hand._replace(v_template=hand.v_template * np.float32(1.0001)) for side, hand in HANDS.items()
    }
    write_mano(tmp_path / "mano.npz", take.motion(tmp_path / "a.npz"), given)
    with np.load(tmp_path / "mano.npz") as stored:
        values = dict(stored)
    assert str(values["hand_model"]) == "as given: MANO's"
    assert values["hand_side"].tolist() == ["right", "left"]
    for index, side in enumerate(("right", "left")):
        seen = take.seen[:, index]
        assert np.isnan(values["hand_pose"][~seen, index]).all()
        pose = np.concatenate(
            [values["global_orient"][seen, index], values["hand_pose"][seen, index]], axis=-1
        ).reshape(-1, 16, 3)
        transl = values["transl"][seen, index] - take.origin
        mesh = hand_mesh(HANDS[side], pose, values["betas"][seen, index], transl)
        np.testing.assert_allclose(mesh.vertices, take.vertices[seen, index], atol=2e-5)
        mean = np.random.default_rng(0).normal(size=45)
        there = to_smplx(pose, mean, side=side)
        np.testing.assert_allclose(from_smplx(there, mean, side=side), pose)


def test_the_shape_of_the_shipped_hand_is_not_called_manos(planted, tmp_path, caplog):
    take = planted()
    write_mano(tmp_path / "mano.npz", take.motion(tmp_path / "a.npz"), HANDS)
    with np.load(tmp_path / "mano.npz") as stored:
        assert "betas" not in stored
        np.testing.assert_allclose(stored["shape_of_shipped_hand"][3], take.shape, atol=1e-6)
        assert "not MANO" in str(stored["hand_model"])
    assert "are not MANO's; give MANO_RIGHT.pkl by --mano" in caplog.text
