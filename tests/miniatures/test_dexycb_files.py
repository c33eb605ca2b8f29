"""The tiny DexYCB says in its files what was planted, by the formulas of the data set's documentation."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures import dexycb
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand
from poem_jax.miniatures.scene import PlantedFrame


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[PlantedFrame]]:
    root = tmp_path_factory.mktemp("DexYCB")
    return root, dexycb.write(root)


def read_yaml(path: Path) -> dict:
    return yaml.safe_load(path.read_text())


def label_of(root: Path, frame: PlantedFrame, serial: str) -> dict[str, np.ndarray]:
    subject, sequence, number = frame.key_hint.split("/")
    with np.load(root / subject / sequence / serial / f"labels_{number}.npz") as file:
        return dict(file)


def test_kept_frames_are_of_right_hands_that_are_seen(written: tuple[Path, list[PlantedFrame]]) -> None:
    root, frames = written
    assert [len(frame.images) for frame in frames] == [8, 7, 8, 8]
    assert {frame.view_names[0] for frame in frames} == {"840412060917"}
    sides = {}
    for meta in sorted(root.glob("*-subject-*/*/meta.yml")):
        sides[str(meta.parent.relative_to(root))] = read_yaml(meta)["mano_sides"]
    kept = {frame.key_hint.rpartition("/")[0] for frame in frames}
    assert kept == {name for name, side in sides.items() if side == ["right"]}
    first = frames[0].key_hint.rpartition("/")[0]
    assert read_yaml(root / first / "meta.yml")["num_frames"] == 3
    for serial in dexycb.SERIALS:
        gone = label_of(root, frames[0]._replace(key_hint=f"{first}/000002"), serial)
        assert (gone["joint_2d"] == -1).all()
    assert (label_of(root, frames[1], "932122061900")["joint_3d"] == -1).all()


def test_files_hold_the_planted_hand(written: tuple[Path, list[PlantedFrame]]) -> None:
    root, frames = written
    components = stand_in_components()
    for frame in frames:
        subject, sequence, number = frame.key_hint.split("/")
        meta = read_yaml(root / subject / sequence / "meta.yml")
        betas = read_yaml(root / "calibration" / f"mano_{meta['mano_calib'][0]}" / "mano.yml")["betas"]
        np.testing.assert_allclose(betas, frame.shape, atol=1e-7)
        for view, serial in enumerate(frame.view_names):
            label = label_of(root, frame, serial)
            assert [label[name].shape for name in ("pose_m", "joint_3d", "joint_2d")] == [
                (1, 51),
                (1, 21, 3),
                (1, 21, 2),
            ]
            np.testing.assert_allclose(label["joint_3d"][0], frame.joints_cam[view], atol=1e-6)
            np.testing.assert_allclose(label["joint_2d"][0] + 0.5, frame.keypoints_px[view], atol=1e-3)
            pose = label["pose_m"][0]
            fingers = components.mean + pose[3:48] @ components.components
            full = np.concatenate([pose[:3], fingers]).reshape(16, 3)
            mesh = hand_mesh(stand_in_hand(), full, np.array(betas, np.float32), translation=pose[48:])
            np.testing.assert_allclose(mesh.vertices, frame.vertices_cam[view], atol=2e-6)
            assert (root / subject / sequence / serial / f"color_{number}.jpg").stat().st_size > 1000
            assert label["seg"].shape == (480, 640)
            assert (label["seg"] == 255).any()


def test_calibration_carries_one_camera_to_the_other(written: tuple[Path, list[PlantedFrame]]) -> None:
    root, frames = written
    for frame in frames:
        subject, sequence, _ = frame.key_hint.split("/")
        meta = read_yaml(root / subject / sequence / "meta.yml")
        file = read_yaml(root / "calibration" / f"extrinsics_{meta['extrinsics']}" / "extrinsics.yml")
        assert file["master"] == "840412060917"
        for view, serial in enumerate(frame.view_names):
            T_master_from_cam = np.reshape(file["extrinsics"][serial], (3, 4))
            in_master = frame.joints_cam[view] @ T_master_from_cam[:, :3].T + T_master_from_cam[:, 3]
            np.testing.assert_allclose(in_master, frame.joints_cam[0], atol=1e-9)
            color = read_yaml(root / "calibration" / "intrinsics" / f"{serial}_640x480.yml")["color"]
            x, y, z = frame.joints_cam[view].T
            u, v = color["fx"] * x / z + color["ppx"] + 0.5, color["fy"] * y / z + color["ppy"] + 0.5
            np.testing.assert_allclose(np.stack([u, v], -1), frame.keypoints_px[view], atol=1e-6)
