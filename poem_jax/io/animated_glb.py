"""A take of meshes as one animated GLB, written by hand: the mesh library writes no animations.

glTF 2.0 (Khronos, 2021): a mesh moves by *morph targets*, offsets of its vertices, mixed by *weights* that
follow a curve in time. A mesh that is seen in n frames has the first as its base and every later one as a
target; at the time of frame k weight k is one and the others are zero, and between frames viewers mix
neighbours. As the curve has n numbers at n times, long takes are cut into pieces of `FRAMES_PER_PIECE`, a
node each, whose scale is zero while it is not to be seen. Normals are left out: viewers then shade the faces
flat, as the standard says.
"""

import json
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from shutil import copyfileobj
from typing import Any, NamedTuple

import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.io.meshes import GENERATOR
from poem_jax.typing import Array, Float, Int

FRAMES_PER_PIECE = 100
_MAX_BYTES = 2**32 - 2**24
"""A GLB says its size in 32 bits; meshes beyond this are left out."""
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_FLOAT, _UINT = 5126, 5125
_INDEX_TARGET, _VERTEX_TARGET = 34963, 34962
_TYPES = {1: "SCALAR", 3: "VEC3"}


class _Piece(NamedTuple):
    """A mesh over some of its frames."""

    name: str
    points: Float[Array, "vert 3"]
    """Its vertices in the first of them."""
    position: int
    """The accessor that holds these."""
    frames: list[int]
    targets: list[int]
    """Accessors of the offsets in the later frames."""


class AnimatedGlb:
    """Meshes that move, gathered frame by frame in an unnamed file, so that memory does not grow."""

    def __init__(
        self,
        path: Path,
        faces: Mapping[str, Int[Array, "face 3"]],
        rgb: Mapping[str, tuple[int, int, int]],
        *,
        seconds_per_frame: float,
        origin: Float[Array, "3"],
    ) -> None:
        """Prepare a file.

        Args:
            path: Ends in `.glb`.
            faces: Triangles of each mesh by its name, counter-clockwise seen from outside.
            rgb: Their colours, 0 to 255.
            seconds_per_frame: Of the animation.
            origin: Where the vertices' frame has its origin, metres: the place of the nodes.
        """
        self.path = path
        self._step, self._origin = seconds_per_frame, np.asarray(origin, float).tolist()
        self._binary = tempfile.TemporaryFile()  # noqa: SIM115
        self._size = self._num_frames = 0
        self._views: list[str] = []
        self._accessors: list[str] = []
        self._pieces: list[_Piece] = []
        self._open: dict[str, _Piece] = {}
        self._materials = {name: index for index, name in enumerate(rgb)}
        self._rgb = rgb
        self._indices = {
            name: self._store(mesh.astype("<u4").ravel(), _INDEX_TARGET) for name, mesh in faces.items()
        }

    def add(self, vertices: Mapping[str, Float[Array, "vert 3"]]) -> None:
        """Append a frame: vertices of the meshes that are seen in it, metres."""
        for name, mesh in vertices.items():
            points = np.asarray(mesh, "<f4")
            piece = self._open.get(name)
            if piece is not None and len(piece.frames) < FRAMES_PER_PIECE:
                piece.targets.append(self._store(points - piece.points, _VERTEX_TARGET))
                piece.frames.append(self._num_frames)
            elif self._size < _MAX_BYTES:
                piece = _Piece(name, points, self._store(points, _VERTEX_TARGET), [self._num_frames], [])
                self._open[name] = piece
                self._pieces.append(piece)
        self._num_frames += 1

    def write(self) -> Path:
        """Write the file, whole or not at all, after the last frame."""
        scene = self._scene()
        lists = f'"bufferViews":[{",".join(self._views)}],"accessors":[{",".join(self._accessors)}]'
        scene["buffers"] = [{"byteLength": self._size}]
        text = f"{json.dumps(scene, separators=(',', ':'))[:-1]},{lists}}}".encode()
        text += b" " * (-len(text) % 4)
        self._binary.seek(0)
        with whole_file(self.path) as temporary, temporary.open("wb") as stream:
            length = _HEADER.size + 2 * _CHUNK.size + len(text) + self._size
            stream.write(_HEADER.pack(b"glTF", 2, length))
            stream.write(_CHUNK.pack(len(text), b"JSON") + text)
            stream.write(_CHUNK.pack(self._size, b"BIN\0"))
            copyfileobj(self._binary, stream)
        return self.path

    def close(self) -> None:
        """Let the gathered frames go; the file stays."""
        self._binary.close()

    def _store(self, array: Array, target: int | None = None) -> int:
        """Append an array of 4-byte numbers, (n,) or (n, 3); return the accessor that holds it."""
        flat = array.reshape(len(array), -1)
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": array.nbytes}
        accessor = {
            "bufferView": len(self._views),
            "componentType": _UINT if array.dtype.kind == "u" else _FLOAT,
            "count": len(array),
            "type": _TYPES[flat.shape[1]],
            "min": flat.min(0).tolist(),
            "max": flat.max(0).tolist(),
        }
        self._views.append(json.dumps(view if target is None else {**view, "target": target}))
        self._accessors.append(json.dumps(accessor))
        self._size += self._binary.write(array.tobytes())
        return len(self._accessors) - 1

    def _scene(self) -> dict[str, Any]:
        channels: list[dict[str, Any]] = []
        samplers: list[dict[str, Any]] = []

        def animate(node: int, what: str, how: str, times: Array, values: Array) -> None:
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": what}})
            seconds = (self._step * np.asarray(times)).astype("<f4")
            output = self._store(np.asarray(values, "<f4"))
            samplers.append({"input": self._store(seconds), "output": output, "interpolation": how})

        nodes = []
        for node, piece in enumerate(self._pieces):
            frames = np.array(piece.frames)
            if piece.targets:
                animate(node, "weights", "LINEAR", frames, np.eye(len(frames))[:, 1:].ravel())
            changes, seen = _visibility(frames, self._num_frames)
            animate(node, "scale", "STEP", changes, np.repeat(seen[:, None], 3, 1))
            scale = [float(seen[0])] * 3
            nodes.append({"name": piece.name, "mesh": node, "translation": self._origin, "scale": scale})
        return {
            "asset": {"version": "2.0", "generator": GENERATOR},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(nodes)))}],
            "nodes": nodes,
            "meshes": [self._mesh(piece) for piece in self._pieces],
            "materials": [_material(colour) for colour in self._rgb.values()],
            "animations": [{"channels": channels, "samplers": samplers}],
        }

    def _mesh(self, piece: _Piece) -> dict[str, Any]:
        primitive: dict[str, Any] = {
            "attributes": {"POSITION": piece.position},
            "indices": self._indices[piece.name],
            "material": self._materials[piece.name],
        }
        if piece.targets:
            primitive["targets"] = [{"POSITION": target} for target in piece.targets]
        return {"name": piece.name, "primitives": [primitive]}


def _visibility(frames: Int[Array, " n"], num_frames: int) -> tuple[Array, Array]:
    """Return at which frames, beginning with 0, a mesh that is seen in `frames` comes and goes, and which."""
    seen = np.zeros(num_frames, bool)
    seen[frames] = True
    changes = np.flatnonzero(np.concatenate([[True], seen[1:] != seen[:-1]]))
    return changes, seen[changes]


def _material(rgb: tuple[int, int, int]) -> dict[str, Any]:
    colour = [*(channel / 255 for channel in rgb), 1.0]
    surface = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 0.8}
    return {"pbrMetallicRoughness": surface, "doubleSided": True}
