"""The skeleton of each hand, by the forward kinematics of its file, against the joints."""

import numpy as np
import pytest

from poem_jax.capture.outputs.skeletons import held_frames, write_skeleton
from poem_jax.hand.topology import JOINT_NAMES
from tests.io.test_bvh import read_bvh


def joints_of(hand, names, world, ends):
    """Places of the named joints and of the tips, (frame, joint, 3) by name."""
    places = {name.removeprefix(f"{hand}_"): world[:, joint, :3, 3] for joint, name in enumerate(names)}
    for name, end in ends.items():
        finger = name.removeprefix(f"{hand}_").partition("_")[0]
        places[f"{finger}_tip"] = (world[:, names.index(name)] @ [*end, 1.0])[:, :3]
    return places


@pytest.mark.parametrize("far", [False, True])
def test_forward_kinematics_give_the_joints(planted, tmp_path, far):
    take = planted(far=far)
    motion = take.motion(tmp_path / "a.npz")
    for index, hand in enumerate(motion.hands):
        write_skeleton(tmp_path / f"{hand.name}.bvh", hand, motion)
        names, _, ends, world, step = read_bvh(tmp_path / f"{hand.name}.bvh")
        assert step == pytest.approx(1 / 25)
        places = joints_of(hand.name, names, world, ends)
        assert places.keys() == set(JOINT_NAMES)
        for frame in np.flatnonzero(take.seen[:, index]):
            expected = motion.upright(take.joints[frame, index])
            for joint, name in enumerate(JOINT_NAMES):
                near = 4e-3 if name.endswith("tip") else 2e-5
                np.testing.assert_allclose(places[name][frame], expected[joint], atol=near)


def test_a_frame_without_the_hand_repeats_the_last(planted, tmp_path):
    motion = planted().motion(tmp_path / "a.npz")
    write_skeleton(tmp_path / "left.bvh", motion.hands[1], motion)
    world = read_bvh(tmp_path / "left.bvh")[3]
    np.testing.assert_array_equal(world[5], world[4])
    np.testing.assert_array_equal(world[0], world[2])
    assert np.abs(world[3] - world[2]).max() > 1e-3
    assert held_frames(np.array([False, True, False, True])).tolist() == [1, 1, 1, 3]


def test_uneven_times_are_drawn_anew(planted, tmp_path):
    """At the moments that both have, and in between on the shortest way."""
    take = planted(uneven=True)
    motion = take.motion(tmp_path / "a.npz")
    write_skeleton(tmp_path / "right.bvh", motion.hands[0], motion)
    names, _, _, world, step = read_bvh(tmp_path / "right.bvh")
    assert step == pytest.approx(np.median(np.diff(take.time_s)))
    wrist = world[:, names.index("right_wrist"), :3, 3]
    expected = motion.upright(take.joints[:, 0, 0])
    times = np.minimum(take.time_s[0] + step * np.arange(len(wrist)), take.time_s[-1])
    for axis in range(3):
        np.testing.assert_allclose(
            wrist[:, axis], np.interp(times, take.time_s, expected[:, axis]), atol=1e-5
        )
    assert times[-1] == pytest.approx(take.time_s[-1], abs=step)
