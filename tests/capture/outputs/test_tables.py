"""Tables hold what `prediction.npz` holds, with empty cells where there is nothing."""

import csv

import numpy as np
import pytest

from poem_jax.capture.outputs.tables import write_angles, write_joints, write_markers
from poem_jax.hand.joint_limits import anatomical_angles, anatomical_axes
from poem_jax.hand.topology import JOINT_NAMES
from tests.capture.outputs.conftest import HANDS


def read(path):
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("far", [False, True])
def test_joints_in_metres_of_the_capture(planted, tmp_path, far):
    take = planted(far=far)
    rows = read(write_joints(tmp_path / "joints.csv", take.motion(tmp_path / "a.npz")))
    assert [row["frame"] for row in rows] == [f"{index:04d}" for index in range(9)]
    for frame, row in enumerate(rows):
        assert float(row["time_s"]) == pytest.approx(take.time_s[frame], abs=1e-6)
        for index, name in enumerate(("right", "left")):
            cells = [row[f"{name}_{joint}_{axis}_m"] for joint in JOINT_NAMES for axis in "xyz"]
            assert row[f"{name}_valid"] == str(int(take.seen[frame, index]))
            if not take.seen[frame, index]:
                assert set(cells) == {""}
                continue
            assert row[f"{name}_bridged"] == str(int(frame == 4))
            expected = take.joints[frame, index].ravel() + np.tile(take.origin, 21)
            np.testing.assert_allclose(np.array(cells, float), expected, atol=2e-6)


def test_angles_are_those_of_the_pose(planted, tmp_path):
    take = planted()
    rows = read(write_angles(tmp_path / "angles.csv", take.motion(tmp_path / "a.npz")))
    for index, (name, hand) in enumerate(HANDS.items()):
        expected = np.rad2deg(anatomical_angles(take.pose[:, index], anatomical_axes(hand)))
        for frame in np.flatnonzero(take.seen[:, index]):
            cell = rows[frame][f"{name}_index_pip_flexion_deg"]
            assert float(cell) == pytest.approx(expected[frame, 1, 0], abs=0.01)
            cell = rows[frame][f"{name}_thumb_cmc_abduction_deg"]
            assert float(cell) == pytest.approx(expected[frame, 12, 1], abs=0.01)


def test_a_bent_finger_has_a_positive_flexion_on_either_hand(planted, tmp_path):
    take = planted()
    bent = np.zeros((16, 3))
    frames = []
    for frame in take.frames:
        hands = []
        for side, hand in zip(("right", "left"), frame.hands, strict=True):
            pose = bent.copy()
            pose[2] = np.deg2rad(60) * anatomical_axes(HANDS[side])[1, 0]
            hands.append(hand._replace(pose=None if hand.pose is None else pose))
        frames.append(frame._replace(hands=tuple(hands)))
    rows = read(
        write_angles(tmp_path / "angles.csv", take._replace(frames=frames).motion(tmp_path / "a.npz"))
    )
    for name in ("right", "left"):
        assert float(rows[3][f"{name}_index_pip_flexion_deg"]) == pytest.approx(60, abs=0.01)


def test_markers_are_upright_in_millimetres(planted, tmp_path):
    take = planted()
    motion = take.motion(tmp_path / "a.npz")
    lines = write_markers(tmp_path / "hands.trc", motion).read_text().splitlines()
    names = [cell for cell in lines[3].split("\t")[2:] if cell]
    assert names == [f"{hand}_{joint}" for hand in ("right", "left") for joint in JOINT_NAMES]
    cells = lines[6 + 3].split("\t")
    assert float(cells[1]) == pytest.approx(take.time_s[3])
    expected = 1000 * motion.upright(take.joints[3]).ravel()
    np.testing.assert_allclose(np.array(cells[2:], float), expected, atol=1e-3)
    assert set(lines[6].split("\t")[2 + 63 :]) == {""}
