"""A mesh whose every vertex moves freely, in a glTF scene.

glTF 2.0 (Khronos, 2021): a mesh moves by *morph targets*, offsets of its vertices, mixed by *weights* that
follow a curve in time. A mesh that is seen in n frames has the first as its base and every later one as a
target; at the time of frame k weight k is one and the others are zero, and between frames viewers mix
neighbours. As the curve has n numbers at n times, long takes are cut into pieces of `FRAMES_PER_PIECE`, a
node each, whose scale is zero while it is not to be seen. Normals are left out: viewers then shade the faces
flat, as the standard says.
"""

from collections.abc import Callable

import numpy as np

from poem_jax.io.glb import MAX_BYTES, VERTEX_TARGET, Glb, visibility
from poem_jax.typing import Array, Bool, Float, Int

FRAMES_PER_PIECE = 100


def add_morphing_mesh(
    glb: Glb,
    name: str,
    faces: Int[Array, "face 3"],
    rgb: tuple[int, int, int],
    vertices_of: Callable[[int], Float[Array, "vert 3"]],
    seen: Bool[Array, " frame"],
    time_s: Float[Array, " frame"],
) -> list[int]:
    """Add a mesh and its motion to a scene; return its nodes, one a piece of the take.

    Args:
        glb: The scene.
        name: Of the nodes and meshes.
        faces: Counter-clockwise seen from outside.
        rgb: Colour, 0 to 255.
        vertices_of: Gives the vertices of a frame, metres; asked for those that are `seen`, in order.
        seen: Frames in which the mesh is there; frames that no longer fit into a GLB are left out.
        time_s: Of every frame, increasing.
    """
    frames, indices, material = np.flatnonzero(seen), glb.triangles(faces), glb.material(rgb)
    nodes = []
    for start in range(0, len(frames), FRAMES_PER_PIECE):
        piece = frames[start : start + FRAMES_PER_PIECE]
        if glb.size > MAX_BYTES:
            break
        nodes.append(_add_piece(glb, name, (indices, material), vertices_of, piece, time_s))
    return nodes


def _add_piece(
    glb: Glb,
    name: str,
    look: tuple[int, int],
    vertices_of: Callable[[int], Array],
    frames: Int[Array, " n"],
    time_s: Array,
) -> int:
    first, *others = frames.tolist()
    base = np.asarray(vertices_of(first), np.float32)
    primitive = {
        "attributes": {"POSITION": glb.store(base, VERTEX_TARGET)},
        "indices": look[0],
        "material": look[1],
    }
    later = [glb.store(np.asarray(vertices_of(frame), np.float32) - base, VERTEX_TARGET) for frame in others]
    if later:
        primitive["targets"] = [{"POSITION": target} for target in later]
    there = np.zeros(len(time_s), bool)
    there[frames] = True
    changes, shown = visibility(there)
    mesh = glb.part("meshes", {"name": name, "primitives": [primitive]})
    node = glb.node(name=name, mesh=mesh, scale=[float(shown[0])] * 3)
    if later:
        glb.animate(node, "weights", glb.times(time_s[frames]), np.eye(len(frames))[:, 1:].ravel())
    glb.animate(node, "scale", glb.times(time_s[changes]), np.repeat(shown[:, None], 3, 1), steps=True)
    return node
