"""A reader of GLB files that knows the standard and nothing of the writer: what is to be seen at a time."""

import functools
import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

COMPONENTS = {5126: "<f4", 5125: "<u4", 5121: "u1"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Gltf:
    def __init__(self, path):
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        assert size % 4 == 0
        self.content = json.loads(data[20 : 20 + size])
        self.nodes = self.content["nodes"]
        self.parents = {
            child: node for node, item in enumerate(self.nodes) for child in item.get("children", [])
        }
        self.binary = b""
        if "buffers" in self.content:
            binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
            assert kind == b"BIN\0"
            self.binary = data[28 + size :]
            assert len(self.binary) == binary_size == self.content["buffers"][0]["byteLength"]
        self.curves = {}
        for animation in self.content.get("animations", []):
            for channel in animation["channels"]:
                target = channel["target"]
                self.curves[target["node"], target["path"]] = animation["samplers"][channel["sampler"]]

    @functools.cache  # noqa: B019
    def array(self, index):
        accessor = self.content["accessors"][index]
        view = self.content["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        kind = COMPONENTS[accessor["componentType"]]
        data = self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        array = np.frombuffer(data, kind).reshape(accessor["count"], WIDTHS[accessor["type"]])
        np.testing.assert_array_equal(array.min(0), accessor["min"])
        np.testing.assert_array_equal(array.max(0), accessor["max"])
        return array

    def at(self, node, path, time, default):
        if (node, path) not in self.curves:
            return self.nodes[node].get(path, default)
        sampler = self.curves[node, path]
        times = self.array(sampler["input"])[:, 0].astype(float)
        assert (np.diff(times) > 0).all()
        values = self.array(sampler["output"]).reshape(len(times), -1).astype(float)
        if sampler["interpolation"] == "STEP":
            return values[max(np.searchsorted(times, time + 1e-6, side="right") - 1, 0)]
        if path == "rotation" and len(times) > 1:
            return Slerp(times, Rotation.from_quat(values))(np.clip(time, times[0], times[-1])).as_quat()
        return np.array([np.interp(time, times, column) for column in values.T])

    @functools.cache  # noqa: B019
    def world(self, node, time):
        """4x4 transform of a node in the scene."""
        own = np.eye(4)
        own[:3, :3] = Rotation.from_quat(self.at(node, "rotation", time, [0, 0, 0, 1])).as_matrix()
        own[:3, :3] *= self.at(node, "scale", time, np.ones(3))
        own[:3, 3] = self.at(node, "translation", time, np.zeros(3))
        return own if node not in self.parents else self.world(self.parents[node], time) @ own

    def seen(self, time):
        """Vertices in the scene and faces by name of what has any extent."""
        shown = {}
        for index, node in enumerate(self.nodes):
            if "mesh" not in node:
                continue
            (primitive,) = self.content["meshes"][node["mesh"]]["primitives"]
            points = self.morphed(index, node["mesh"], primitive, time)
            if "skin" in node:
                assert index in self.content["scenes"][0]["nodes"]
                points = self.skinned(self.content["skins"][node["skin"]], primitive, points, time)
            else:
                world = self.world(index, time)
                points = points @ world[:3, :3].T + world[:3, 3]
            if np.ptp(points, axis=0).max() > 1e-6:
                assert node["name"] not in shown, "one piece at a time"
                shown[node["name"]] = points, self.array(primitive["indices"]).reshape(-1, 3)
        return shown

    def morphed(self, index, mesh, primitive, time):
        points = self.array(primitive["attributes"]["POSITION"]).astype(float)
        weights = self.at(index, "weights", time, self.content["meshes"][mesh].get("weights", []))
        for weight, target in zip(weights, primitive.get("targets", []), strict=True):
            points += weight * self.array(target["POSITION"])
        return points

    def skinned(self, skin, primitive, points, time):
        joints = self.array(primitive["attributes"]["JOINTS_0"])
        weights = self.array(primitive["attributes"]["WEIGHTS_0"])
        binds = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        moves = np.stack([self.world(node, time) for node in skin["joints"]]) @ binds
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        return np.einsum("vk,vkij,vj->vi", weights, moves[joints], homogeneous)[:, :3]
