"""BVH, read again by a reader that follows the keywords of the file, and by one from PyPI."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poem_jax.io.bvh import BvhSkeleton, write_bvh


def read_bvh(path):
    """Return names, parents, ends, transforms in the world (frame, joint, 4, 4) and the frame time."""
    words = path.read_text().split()
    names, parents, offsets, channels, ends, open_joints = [], [], [], [], {}, []
    place = words.index("HIERARCHY") + 1
    while words[place] != "MOTION":
        word = words[place]
        if word in ("ROOT", "JOINT"):
            parents.append(open_joints[-1] if open_joints else -1)
            names.append(words[place + 1])
            current, place = len(names) - 1, place + 2
        elif word == "End":
            current, place = None, place + 2
        elif word == "{":
            open_joints.append(current)
            place += 1
        elif word == "}":
            open_joints.pop()
            place += 1
        elif word == "OFFSET":
            offset = [float(number) for number in words[place + 1 : place + 4]]
            if current is None:
                ends[names[open_joints[-2]]] = np.array(offset)
            else:
                offsets.append(offset)
            place += 4
        elif word == "CHANNELS":
            count = int(words[place + 1])
            channels.append(words[place + 2 : place + 2 + count])
            place += 2 + count
    frames, step = int(words[place + 2]), float(words[place + 5])
    numbers = np.array(words[place + 6 :], float).reshape(frames, -1)
    world = np.zeros((frames, len(names), 4, 4))
    column = 0
    for joint, (parent, kinds) in enumerate(zip(parents, channels, strict=True)):
        own = np.tile(np.eye(4), (frames, 1, 1))
        own[:, :3, 3] = offsets[joint]
        for kind in kinds:
            turn, values = np.tile(np.eye(4), (frames, 1, 1)), numbers[:, column]
            if kind.endswith("position"):
                turn[:, "XYZ".index(kind[0]), 3] = values
            else:
                turn[:, :3, :3] = Rotation.from_euler(kind[0], values[:, None], degrees=True).as_matrix()
            own, column = own @ turn, column + 1
        world[:, joint] = own if parent < 0 else world[:, parent] @ own
    assert column == numbers.shape[1]
    return names, parents, ends, world, step


def planted(frames=7, joints=5):
    rng = np.random.default_rng(0)
    rotations = Rotation.random(frames * joints, rng=rng).as_matrix().reshape(frames, joints, 3, 3)
    # The order of a file is depth first: joint 2 comes after 3 and 4 there.
    skeleton = BvhSkeleton(
        [f"joint_{i}" for i in range(joints)],
        (-1, 0, 0, 1, 3),
        rng.normal(size=(joints, 3)),
        {4: np.ones(3), 2: -np.ones(3)},
    )
    return skeleton, rng.normal(size=(frames, 3)), rotations


def forward(skeleton, root, rotations):
    world = np.tile(np.eye(4), (*rotations.shape[:2], 1, 1))
    world[..., :3, :3] = rotations
    world[:, 0, :3, 3] = root
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            world[:, joint, :3, 3] = skeleton.offsets[joint]
            world[:, joint] = world[:, parent] @ world[:, joint]
    return world


def test_a_reader_finds_every_joint_where_it_was(tmp_path):
    skeleton, root, rotations = planted()
    write_bvh(tmp_path / "hand.bvh", skeleton, root, rotations, 1 / 30)
    names, parents, ends, world, step = read_bvh(tmp_path / "hand.bvh")
    order = [skeleton.names.index(name) for name in names]
    assert order == [0, 1, 3, 4, 2]
    assert [order[parent] if parent >= 0 else -1 for parent in parents] == [
        skeleton.parents[j] for j in order
    ]
    np.testing.assert_allclose(world, forward(skeleton, root, rotations)[:, order], atol=5e-6)
    assert ends.keys() == {"joint_4", "joint_2"}
    assert step == pytest.approx(1 / 30, abs=1e-9)


def test_a_public_reader_opens_it(tmp_path):
    bvh = pytest.importorskip("bvh")
    skeleton, root, rotations = planted()
    write_bvh(tmp_path / "hand.bvh", skeleton, root, rotations, 0.02)
    read = bvh.Bvh((tmp_path / "hand.bvh").read_text())
    assert (read.nframes, read.frame_time) == (7, 0.02)
    assert read.joint_channels("joint_3") == ["Zrotation", "Xrotation", "Yrotation"]
    assert read.joint_parent("joint_4").name == "joint_3"
    angles = [read.frame_joint_channel(3, "joint_4", f"{axis}rotation") for axis in "ZXY"]
    turn = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    np.testing.assert_allclose(turn, rotations[3, 4], atol=1e-6)


def test_a_quarter_turn_about_x_is_written_without_a_word(tmp_path):
    skeleton = BvhSkeleton(["one"], (-1,), np.zeros((1, 3)), {0: np.ones(3)})
    turns = Rotation.from_euler("X", [[80.0], [90.0], [100.0]], degrees=True).as_matrix()[:, None]
    write_bvh(tmp_path / "hand.bvh", skeleton, np.zeros((3, 3)), turns, 0.1)
    np.testing.assert_allclose(read_bvh(tmp_path / "hand.bvh")[3][:, 0, :3, :3], turns[:, 0], atol=1e-6)


def test_angles_do_not_jump_by_full_turns(tmp_path):
    skeleton = BvhSkeleton(["one"], (-1,), np.zeros((1, 3)), {0: np.ones(3)})
    degrees = np.arange(0.0, 720, 20)[:, None]
    turns = Rotation.from_euler("Z", degrees, degrees=True).as_matrix()[:, None]
    write_bvh(tmp_path / "hand.bvh", skeleton, np.zeros((len(turns), 3)), turns, 0.1)
    rows = np.loadtxt(tmp_path / "hand.bvh", skiprows=13)
    np.testing.assert_allclose(rows[:, 3], degrees[:, 0], atol=1e-5)
