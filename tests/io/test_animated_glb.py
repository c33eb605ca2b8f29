"""The animated GLB, read again by a reader that knows the standard and nothing of the writer."""

import json
import struct

import numpy as np
import pytest
import trimesh

from poem_jax.io import animated_glb
from poem_jax.io.animated_glb import AnimatedGlb
from poem_jax.io.meshes import is_own_mesh

FACES = {"right": np.array([[0, 1, 2], [0, 2, 3]]), "left": np.array([[0, 2, 1]])}
RGB = {"right": (255, 0, 0), "left": (0, 0, 255)}
STEP = 0.5
ORIGIN = np.array([1000.0, -20.0, 3.0])


class Gltf:
    """Just enough of a viewer: what is seen at a time, in the world."""

    def __init__(self, path):
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        assert size % 4 == 0
        self.content = json.loads(data[20 : 20 + size])
        binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert kind == b"BIN\0"
        self.binary = data[28 + size :]
        assert len(self.binary) == binary_size == self.content["buffers"][0]["byteLength"]

    def array(self, index):
        accessor = self.content["accessors"][index]
        view = self.content["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        data = self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        array = np.frombuffer(data, kind).reshape(accessor["count"], -1)
        np.testing.assert_array_equal(array.min(0), accessor["min"])
        np.testing.assert_array_equal(array.max(0), accessor["max"])
        return array.squeeze(-1) if accessor["type"] == "SCALAR" else array

    def curve(self, node, path, time):
        (animation,) = self.content["animations"]
        for channel in animation["channels"]:
            if channel["target"] == {"node": node, "path": path}:
                sampler = animation["samplers"][channel["sampler"]]
                times = self.array(sampler["input"])
                values = self.array(sampler["output"]).reshape(len(times), -1)
                assert (np.diff(times) > 0).all()
                if sampler["interpolation"] == "STEP":
                    return values[max(np.searchsorted(times, time, side="right") - 1, 0)]
                return np.array([np.interp(time, times, column) for column in values.T])
        return None

    def seen(self, time):
        """Vertices and faces by name of what is to be seen."""
        shown = {}
        for index, node in enumerate(self.content["nodes"]):
            scale = self.curve(index, "scale", time)
            (primitive,) = self.content["meshes"][node["mesh"]]["primitives"]
            if not scale.any():
                continue
            assert node["name"] not in shown, "one piece at a time"
            points = self.array(primitive["attributes"]["POSITION"]).copy()
            weights = self.curve(index, "weights", time)
            weights = [] if weights is None else weights
            for weight, target in zip(weights, primitive.get("targets", []), strict=True):
                points += weight * self.array(target["POSITION"])
            faces = self.array(primitive["indices"]).reshape(-1, 3)
            shown[node["name"]] = points * scale + node["translation"], faces
        return shown


def write(path, frames):
    animation = AnimatedGlb(path, FACES, RGB, seconds_per_frame=STEP, origin=ORIGIN)
    for frame in frames:
        animation.add(frame)
    animation.write()
    animation.close()
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
    monkeypatch.setattr(animated_glb, "FRAMES_PER_PIECE", frames_per_piece)
    present = np.random.default_rng(1).random((9, 2)) < 0.7
    present[:2] = [[True, False], [True, True]]
    frames = take(present)
    gltf = write(tmp_path / "hands.glb", frames)
    for index, frame in enumerate(frames):
        seen = gltf.seen(STEP * index)
        assert seen.keys() == frame.keys()
        for name, (points, faces) in seen.items():
            np.testing.assert_allclose(points - ORIGIN, frame[name], atol=1e-5)
            np.testing.assert_array_equal(faces, FACES[name])


def test_between_frames_the_mesh_moves_evenly(tmp_path):
    frames = take([[True, False]] * 3)
    gltf = write(tmp_path / "hands.glb", frames)
    points, _ = gltf.seen(1.25 * STEP)["right"]
    expected = 0.75 * frames[1]["right"] + 0.25 * frames[2]["right"]
    np.testing.assert_allclose(points - ORIGIN, expected, atol=1e-5)


def test_another_reader_opens_it(tmp_path):
    frames = take([[True, True]] * 4)
    write(tmp_path / "hands.glb", frames)
    scene = trimesh.load_scene(tmp_path / "hands.glb", process=False)
    assert set(scene.geometry) == {"right", "left"}
    np.testing.assert_allclose(scene.geometry["right"].vertices, frames[0]["right"], atol=1e-6)
    np.testing.assert_array_equal(scene.geometry["right"].faces, FACES["right"])
    assert is_own_mesh(tmp_path / "hands.glb")


def test_a_take_without_meshes_is_a_file_too(tmp_path):
    assert write(tmp_path / "hands.glb", [{}, {}]).seen(0.0) == {}


def test_the_file_grows_with_the_frames_and_not_with_their_square(tmp_path):
    sizes = []
    for count in (200, 400):
        write(tmp_path / "hands.glb", take([[True, True]] * count))
        sizes.append((tmp_path / "hands.glb").stat().st_size)
    assert sizes[1] < 2.1 * sizes[0]
