"""The tiny HO-3D says in its files what was planted, by the formulas of the data set's documentation."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures import ho3d
from poem_jax.miniatures.mano_stand_in import stand_in_hand
from poem_jax.miniatures.scene import PlantedFrame

GATHER = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]
OPENGL = np.array([1, -1, -1])


@pytest.fixture(scope="session", params=["v2", "v3"])
def written(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> tuple[Path, list[PlantedFrame], str]:
    root = tmp_path_factory.mktemp("ho3d")
    return (
        root,
        ho3d.write(root, frames=2 if request.param == "v3" else 1, version=request.param),
        request.param,
    )


def views_of(root: Path, frame: PlantedFrame, version: str):
    """(view, folder of the split, sequence, frame's name) of every camera."""
    main, name = frame.key_hint.split("/")
    for view, camera in enumerate(frame.view_names):
        sequence = camera if camera == main else main + camera
        held_out = main in ("AP1", "MPM1", "SM1") or sequence in ("SB11", "SB13")
        yield view, root / f"HO3D_{version}" / ("evaluation" if held_out else "train"), sequence, name


def test_lists_and_files_agree(written: tuple[Path, list[PlantedFrame], str]) -> None:
    root, frames, version = written
    suffix = "jpg" if version == "v3" else "png"
    listed = set()
    for split in ("train", "evaluation"):
        lines = (root / f"HO3D_{version}" / f"{split}.txt").read_text().split()
        listed |= {(split, *line.split("/")) for line in lines}
    for split, sequence, name in listed:
        folder = root / f"HO3D_{version}" / split / sequence
        for file in (f"rgb/{name}.{suffix}", f"depth/{name}.png", f"meta/{name}.pkl"):
            assert (folder / file).is_file()
    planted = set()
    for frame in frames:
        alone = frame.key_hint.startswith("SM1")
        assert frame.view_names == (("SM1",) if alone else ("2", "0", "1", "3", "4"))
        planted |= {(folder.name, seq, name) for _, folder, seq, name in views_of(root, frame, version)}
    assert listed - planted == {("train", "SM2", "0000")}
    assert planted <= listed


def test_files_hold_the_planted_hand(written: tuple[Path, list[PlantedFrame], str]) -> None:
    root, frames, version = written
    for frame in frames:
        for view, folder, sequence, name in views_of(root, frame, version):
            meta = pickle.loads((folder / sequence / "meta" / f"{name}.pkl").read_bytes())
            uv = frame.joints_cam[view] @ meta["camMat"].T
            np.testing.assert_allclose(uv[:, :2] / uv[:, 2:] + 0.5, frame.keypoints_px[view], atol=1e-6)
            if folder.name == "evaluation":
                np.testing.assert_allclose(
                    meta["handJoints3D"] * OPENGL, frame.joints_cam[view, 0], atol=1e-6
                )
                box = np.array(meta["handBoundingBox"]) + 0.5
                assert (box[:2] < frame.keypoints_px[view].min(0)).all()
                assert (box[2:] > frame.keypoints_px[view].max(0)).all()
                continue
            joints = (meta["handJoints3D"] * OPENGL)[GATHER]
            np.testing.assert_allclose(joints, frame.joints_cam[view], atol=1e-6)
            pose = meta["handPose"].reshape(16, 3)
            mesh = hand_mesh(stand_in_hand(), pose, meta["handBeta"], translation=meta["handTrans"])
            np.testing.assert_allclose(mesh.vertices * OPENGL, frame.vertices_cam[view], atol=2e-6)


def test_what_is_held_out_lies_in_the_archives(written: tuple[Path, list[PlantedFrame], str]) -> None:
    root, frames, version = written
    data = root / f"HO3D_{version}"
    lines = (data / "evaluation.txt").read_text().split()
    joints, vertices = (json.loads((data / f"evaluation_{n}.json").read_text()) for n in ("xyz", "verts"))
    assert len(lines) == len(joints) == len(vertices) > 0
    running: dict[str, int] = {}
    for frame in frames:
        for view, folder, sequence, name in views_of(root, frame, version):
            if folder.name == "train":
                continue
            row = lines.index(f"{sequence}/{name}")
            np.testing.assert_allclose((joints[row] * OPENGL)[GATHER], frame.joints_cam[view], atol=1e-9)
            np.testing.assert_allclose(vertices[row] * OPENGL, frame.vertices_cam[view], atol=1e-9)
            number = running[sequence] = running.get(sequence, -1) + 1
            archive = root / "HO3D_v3_manual_test_gt" / sequence / "meta" / f"{number:04d}.pkl"
            assert archive.is_file() == (version == "v3" and sequence.startswith("SB1"))
            if not archive.is_file():
                continue
            truth = pickle.loads(archive.read_bytes())
            np.testing.assert_allclose(truth["target_joints_3d"], frame.joints_cam[view], atol=1e-6)
            np.testing.assert_allclose(truth["target_verts_3d"], frame.vertices_cam[view], atol=1e-6)
            np.testing.assert_allclose(truth["mano_pose"].reshape(16, 3), frame.pose_cam[view], atol=1e-6)


def test_calibration_carries_one_camera_to_the_other(
    written: tuple[Path, list[PlantedFrame], str],
) -> None:
    root, frames, version = written
    assert (root / f"HO3D_{version}" / "calibration").is_dir() == (version == "v3")
    for frame in frames if version == "v3" else ():
        main = frame.key_hint.split("/")[0]
        if main == "SM1":
            continue
        folder = root / "HO3D_v3" / "calibration" / main / "calibration"
        orders = np.loadtxt(folder / "cam_orders.txt").astype(int)
        common = []
        for view, digit in enumerate(frame.view_names):
            T_common_from_cam = np.loadtxt(folder / f"trans_{orders[int(digit)]}.txt")
            common.append(frame.joints_cam[view] @ T_common_from_cam[:3, :3].T + T_common_from_cam[:3, 3])
        np.testing.assert_allclose(common, np.broadcast_to(common[0], np.shape(common)), atol=1e-9)
