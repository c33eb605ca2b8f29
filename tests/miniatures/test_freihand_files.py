"""The tiny FreiHAND says in its files what was planted, by the formulas of the data set's documentation."""

import json
from pathlib import Path

import numpy as np
import pytest

from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures import freihand
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand
from poem_jax.miniatures.scene import PlantedFrame


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[PlantedFrame]]:
    root = tmp_path_factory.mktemp("freihand")
    return root, freihand.write(root)


@pytest.mark.parametrize("split", ["training", "evaluation"])
def test_files_hold_the_planted_hands(written: tuple[Path, list[PlantedFrame]], split: str) -> None:
    root, planted = written
    frames = [frame for frame in planted if frame.key_hint.startswith(split)]
    folder = root / ("FreiHAND_v2" if split == "training" else "FreiHAND_v2_eval")
    labels = {
        name: json.loads((folder / f"{split}_{name}.json").read_text())
        for name in ("K", "scale", "xyz", "verts", "mano")
    }
    assert {len(rows) for rows in labels.values()} == {len(frames)} == {2}
    for n, frame in enumerate(frames):
        xyz, K = np.array(labels["xyz"][n]), np.array(labels["K"][n])
        np.testing.assert_allclose(xyz, frame.joints_cam[0], atol=1e-9)
        np.testing.assert_allclose(labels["verts"][n], frame.vertices_cam[0], atol=1e-9)
        uv = xyz @ K.T
        uv = uv[:, :2] / uv[:, 2:]
        np.testing.assert_allclose(uv + 0.5, frame.keypoints_px[0], atol=1e-6)
        assert (uv > 0).all()
        assert (uv < 224).all()
        np.testing.assert_allclose(np.linalg.norm(xyz[10] - xyz[9]), labels["scale"][n])
        (mano,) = np.array(labels["mano"][n])
        assert mano.shape == (61,)
        fingers = stand_in_components().mean + mano[3:48]
        pose = np.concatenate([mano[:3], fingers]).reshape(16, 3)
        mesh = hand_mesh(stand_in_hand(), pose, mano[48:58])
        np.testing.assert_allclose(
            mesh.vertices - mesh.joints[9], frame.vertices_cam[0] - frame.joints_cam[0, 9], atol=1e-6
        )
        np.testing.assert_allclose(mano[58:60], uv[9], atol=1e-6)


def test_training_samples_have_four_pictures(written: tuple[Path, list[PlantedFrame]]) -> None:
    root, _ = written
    data = root / "FreiHAND_v2"
    names = [f"{n:08d}" for n in range(8)]
    assert sorted(path.stem for path in (data / "training" / "rgb").glob("*.jpg")) == names
    assert sorted(path.stem for path in (data / "training" / "mask").glob("*.jpg")) == names[:2]
    for folder, suffix in (("rgb", "jpg"), ("segmap", "png")):
        found = (data / "evaluation" / folder).glob(f"*.{suffix}")
        assert sorted(path.stem for path in found) == names[:2]
    assert len({(data / "training" / "rgb" / f"{name}.jpg").read_bytes() for name in names}) == 8
    assert not (data / "evaluation_xyz.json").exists()
