"""A glTF 2.0 scene (Khronos, 2021) put together piece by piece and written as one binary file.

The mesh library writes neither skins nor animations, so this is done by hand. Numbers are gathered in an
unnamed file, and what stands about them in the JSON as text, so that memory hardly grows with a take.
"""

import json
import struct
import tempfile
from pathlib import Path
from shutil import copyfileobj
from typing import Any

import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.io.meshes import GENERATOR
from poem_jax.typing import Array, Float, Int

MAX_BYTES = 2**32 - 2**26
"""A GLB says its size in 32 bits, and needs room for its JSON and the last piece."""
INDEX_TARGET, VERTEX_TARGET = 34963, 34962
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_COMPONENTS = {"f": (5126, "<f4"), "u": (5125, "<u4"), "B": (5121, "u1")}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Glb:
    """A scene in the making; use it in a `with` block, at whose end the gathered numbers go."""

    def __init__(self) -> None:
        self.nodes: list[dict[str, Any]] = []
        """May be changed until the file is written; their numbers are their places."""
        self.roots: list[int] = []
        """Nodes that hang on no other."""
        self._parts: dict[str, list[dict[str, Any]]] = {"meshes": [], "materials": [], "skins": []}
        self._channels: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        self._views: list[str] = []
        self._accessors: list[str] = []
        self._binary = tempfile.TemporaryFile()  # noqa: SIM115
        self.size = 0
        """Bytes of numbers so far."""

    def __enter__(self) -> "Glb":
        return self

    def __exit__(self, *_: object) -> None:
        self._binary.close()

    def node(self, **content: Any) -> int:
        """Add a node; return its number."""
        self.nodes.append(content)
        return len(self.nodes) - 1

    def part(self, kind: str, content: dict[str, Any]) -> int:
        """Add one of the `meshes`, `materials` or `skins`; return its number."""
        self._parts[kind].append(content)
        return len(self._parts[kind]) - 1

    def material(self, rgb: tuple[int, int, int]) -> int:
        """Add a dull surface of a colour (0 to 255), seen from both sides; return its number."""
        colour = [*(channel / 255 for channel in rgb), 1.0]
        surface = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 0.8}
        return self.part("materials", {"pbrMetallicRoughness": surface, "doubleSided": True})

    def store(self, array: Array, target: int | None = None) -> int:
        """Append floats, unsigned numbers or bytes, (n,) or (n, 3 or 4 or 16); return their accessor.

        Args:
            array: At least one entry; bytes (uint8) by fours.
            target: `INDEX_TARGET` or `VERTEX_TARGET` for what a mesh consists of.
        """
        kind = "B" if array.dtype == np.uint8 else array.dtype.kind
        component, stored = _COMPONENTS[kind]
        flat = np.ascontiguousarray(array.reshape(len(array), -1), stored)
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": flat.nbytes}
        accessor = {
            "bufferView": len(self._views),
            "componentType": component,
            "count": len(flat),
            "type": _TYPES[flat.shape[1]],
            "min": flat.min(0).tolist(),
            "max": flat.max(0).tolist(),
        }
        self._views.append(json.dumps(view if target is None else {**view, "target": target}))
        self._accessors.append(json.dumps(accessor))
        self.size += self._binary.write(flat.tobytes())
        return len(self._accessors) - 1

    def triangles(self, faces: Int[Array, "face 3"]) -> int:
        """Append triangles; return their accessor."""
        return self.store(np.asarray(faces).astype(np.uint32).ravel(), INDEX_TARGET)

    def times(self, seconds: Float[Array, " n"]) -> int:
        """Append times, which must increase; return their accessor, which several curves may share."""
        return self.store(np.asarray(seconds, np.float32))

    def animate(self, node: int, path: str, times: int, values: Array, *, steps: bool = False) -> None:
        """Let a node's `translation`, `rotation`, `scale` or `weights` follow a curve.

        Args:
            node: Its number.
            path: What moves.
            times: Accessor from `times`.
            values: One row a time; quaternions as x, y, z, w; weights in one long row.
            steps: Keep each value until the next one's time, instead of going evenly from one to the next.
        """
        output, how = self.store(np.asarray(values, np.float32)), "STEP" if steps else "LINEAR"
        sampler = {"input": times, "output": output, "interpolation": how}
        self._channels.append({"sampler": len(self._samplers), "target": {"node": node, "path": path}})
        self._samplers.append(sampler)

    def write(self, path: Path) -> Path:
        """Write the file, whole or not at all."""
        text = self._json()
        text += b" " * (-len(text) % 4)
        self._binary.seek(0)
        with whole_file(path) as temporary, temporary.open("wb") as stream:
            length = _HEADER.size + _CHUNK.size + len(text) + (_CHUNK.size + self.size) * bool(self.size)
            stream.write(_HEADER.pack(b"glTF", 2, length))
            stream.write(_CHUNK.pack(len(text), b"JSON") + text)
            if self.size:
                stream.write(_CHUNK.pack(self.size, b"BIN\0"))
                copyfileobj(self._binary, stream)
        return path

    def _json(self) -> bytes:
        scene: dict[str, Any] = {
            # First, where `is_own_mesh` looks for it.
            "asset": {"version": "2.0", "generator": GENERATOR},
            "scene": 0,
            "scenes": [{"nodes": self.roots}],
            "nodes": self.nodes,
            **{kind: parts for kind, parts in self._parts.items() if parts},
        }
        if self._channels:
            scene["animations"] = [
                {"name": "take", "channels": self._channels, "samplers": self._samplers},
            ]
        if self.size:
            scene["buffers"] = [{"byteLength": self.size}]
        text = json.dumps(scene, separators=(",", ":"))[:-1]
        if self.size:
            text += f',"bufferViews":[{",".join(self._views)}],"accessors":[{",".join(self._accessors)}]'
        return f"{text}}}".encode()


def visibility(seen: Array) -> tuple[Array, Array]:
    """Return at which frames, beginning with 0, something comes and goes, and whether it is then there.

    Args:
        seen: (frame,), True where it is to be seen.
    """
    seen = np.asarray(seen, bool)
    changes = np.flatnonzero(np.concatenate([[True], seen[1:] != seen[:-1]]))
    return changes, seen[changes]
