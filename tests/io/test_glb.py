"""Meshes that morph, and meshes that are skinned, read again by a reader that knows the standard alone."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from poem_jax.io import morphing_mesh
from poem_jax.io.glb import Glb
from poem_jax.io.meshes import is_own_mesh
from poem_jax.io.morphing_mesh import add_morphing_mesh
from poem_jax.io.skinned_mesh import Skin, SkinMotion, add_skinned_mesh, strongest
from tests.io.gltf import Gltf

FACES = {"right": np.array([[0, 1, 2], [0, 2, 3]]), "left": np.array([[0, 2, 1]])}
RGB = {"right": (255, 0, 0), "left": (0, 0, 255)}
STEP = 0.5


def write(path, frames):
    with Glb() as glb:
        for name, faces in FACES.items():
            seen = np.array([name in frame for frame in frames])
            time_s = STEP * np.arange(len(frames))
            meshes = [frame.get(name) for frame in frames]
            glb.roots += add_morphing_mesh(glb, name, faces, RGB[name], meshes.__getitem__, seen, time_s)
        glb.write(path)
    return Gltf(path)


def take(present):
    """Frames in which each mesh is there as `present` says: (frame, 2)."""
    rng = np.random.default_rng(0)
    vertices = {"right": 4, "left": 3}
    return [
        {
            name: rng.normal(size=(vertices[name], 3)).astype(np.float32)
            for name, there in zip(FACES, row, strict=True)
            if there
        }
        for row in present
    ]


@pytest.mark.parametrize("frames_per_piece", [2, 3, 100])
def test_every_frame_is_seen_at_its_time(tmp_path, monkeypatch, frames_per_piece):
    monkeypatch.setattr(morphing_mesh, "FRAMES_PER_PIECE", frames_per_piece)
    present = np.random.default_rng(1).random((9, 2)) < 0.7
    present[:2] = [[True, False], [True, True]]
    frames = take(present)
    gltf = write(tmp_path / "hands.glb", frames)
    for index, frame in enumerate(frames):
        seen = gltf.seen(STEP * index)
        assert seen.keys() == frame.keys()
        for name, (points, faces) in seen.items():
            np.testing.assert_allclose(points, frame[name], atol=1e-5)
            np.testing.assert_array_equal(faces, FACES[name])


def test_between_frames_the_mesh_moves_evenly(tmp_path):
    frames = take([[True, False]] * 3)
    gltf = write(tmp_path / "hands.glb", frames)
    points, _ = gltf.seen(1.25 * STEP)["right"]
    expected = 0.75 * frames[1]["right"] + 0.25 * frames[2]["right"]
    np.testing.assert_allclose(points, expected, atol=1e-5)


def test_another_reader_opens_it(tmp_path):
    frames = take([[True, True]] * 4)
    write(tmp_path / "hands.glb", frames)
    scene = trimesh.load_scene(tmp_path / "hands.glb", process=False)
    assert set(scene.geometry) == {"right", "left"}
    np.testing.assert_allclose(scene.geometry["right"].vertices, frames[0]["right"], atol=1e-6)
    np.testing.assert_array_equal(scene.geometry["right"].faces, FACES["right"])
    assert is_own_mesh(tmp_path / "hands.glb")


def test_the_file_grows_with_the_frames_and_not_with_their_square(tmp_path):
    sizes = []
    for count in (200, 400):
        write(tmp_path / "hands.glb", take([[True, True]] * count))
        sizes.append((tmp_path / "hands.glb").stat().st_size)
    assert sizes[1] < 2.1 * sizes[0]


def test_a_skinned_mesh_goes_where_its_joints_carry_it(tmp_path):
    """Against linear blend skinning written out, with morph targets, times that are uneven, and a gap."""
    rng = np.random.default_rng(2)
    parents, joints = (-1, 0, 1, 0), rng.normal(size=(4, 3))
    vertices, targets = rng.normal(size=(6, 3)), rng.normal(size=(2, 6, 3))
    weights = rng.random((6, 4))
    weights /= weights.sum(1, keepdims=True)
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    skin = Skin(vertices, faces, weights, joints, parents, ("a", "b", "c", "d"), targets)
    time_s = np.array([0.0, 0.1, 0.4, 0.5, 1.5])
    seen = np.array([True, False, True, True, True])
    rotations = Rotation.random(20, rng=rng).as_matrix().reshape(5, 4, 3, 3)
    wxyz = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat()[:, [3, 0, 1, 2]].reshape(5, 4, 4)
    root, mix = rng.normal(size=(5, 3)), rng.normal(size=(5, 2))
    with Glb() as glb:
        mesh, first = add_skinned_mesh(
            glb, "right", (1, 2, 3), skin, SkinMotion(time_s, seen, wxyz, root, mix)
        )
        glb.roots += [mesh, first]
        glb.write(tmp_path / "hands.glb")
    gltf = Gltf(tmp_path / "hands.glb")
    for frame in range(5):
        if not seen[frame]:
            assert gltf.seen(time_s[frame]) == {}
            continue
        rest = vertices + np.einsum("k,kvc->vc", mix[frame], targets)
        turns, places = [rotations[frame, 0]], [root[frame]]
        for joint in (1, 2, 3):
            parent = parents[joint]
            places.append(places[parent] + turns[parent] @ (joints[joint] - joints[parent]))
            turns.append(turns[parent] @ rotations[frame, joint])
        carried = [(rest - joints[j]) @ turns[j].T + places[j] for j in range(4)]
        expected = np.einsum("vj,jvc->vc", weights, carried)
        np.testing.assert_allclose(gltf.seen(time_s[frame])["right"][0], expected, atol=1e-5)
    assert [gltf.nodes[node]["name"] for node in gltf.content["skins"][0]["joints"]][1] == "right_b"


def test_four_joints_pull_and_their_weights_add_up_to_one():
    weights = np.array([[0.5, 0, 0.3, 0.1, 0.06, 0.04], [0, 0, 0, 0, 0, 1.0]])
    joints, pull = strongest(weights)
    assert joints[0].tolist() == [0, 2, 3, 4]
    assert joints[1].tolist() == [5, 0, 0, 0]
    np.testing.assert_allclose(pull[0], np.array([0.5, 0.3, 0.1, 0.06]) / 0.96, atol=1e-6)
    assert (pull.sum(1) == 1).all()
