"""A mesh that follows a skeleton, in a glTF scene: linear blend skinning with corrections of the pose.

glTF 2.0 (Khronos, 2021, 3.7.3): a vertex v of the rest mesh, moved by its weighted morph targets, goes to
sum_j w_j G_j B_j v, G_j = transform of joint node j in the scene, B_j = inverse of its place at rest. All
joints rest unturned here, so B_j is a translation. Four joints may pull at a vertex, as viewers support no
more. The place of the node that holds the mesh does not count; it stands at the scene's root, as the standard
advises.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.io.glb import VERTEX_TARGET, Glb, visibility
from poem_jax.typing import Array, Bool, Float, Int

_INFLUENCES = 4


class Skin(NamedTuple):
    """A mesh at rest and the skeleton in it. Metres."""

    vertices: Float[Array, "vert 3"]
    faces: Int[Array, "face 3"]
    """Counter-clockwise seen from outside."""
    weights: Float[Array, "vert joint"]
    joints: Float[Array, "joint 3"]
    """Places at rest."""
    parents: tuple[int, ...]
    """Of each joint, -1 for the first, which is the root."""
    joint_names: tuple[str, ...]
    targets: Float[Array, "target vert 3"]
    """Offsets of the vertices at rest, to be mixed; there may be none."""


class SkinMotion(NamedTuple):
    """How a skeleton moves; what is not `seen` may be NaN."""

    time_s: Float[Array, " frame"]
    """Increasing."""
    seen: Bool[Array, " frame"]
    turns: Float[Array, "frame joint 4"]
    """Each joint's rotation against its parent, the root's in the world: unit quaternions w, x, y, z."""
    root: Float[Array, "frame 3"]
    """Place of the first joint, metres."""
    target_weights: Float[Array, "frame target"]


def add_skinned_mesh(
    glb: Glb, name: str, rgb: tuple[int, int, int], skin: Skin, motion: SkinMotion
) -> tuple[int, int]:
    """Add a skinned mesh and its motion to a scene.

    While it is not to be seen, the scale of its root joint is zero.

    Args:
        glb: The scene.
        name: Of the mesh; joints are called `<name>_<joint>`.
        rgb: Colour, 0 to 255.
        skin: What moves.
        motion: How; seen in one frame at least.

    Returns: the node of the mesh, which belongs at the root of the scene, and that of the first joint.
    """
    frames = np.flatnonzero(motion.seen)
    quaternions = _continuous(np.asarray(motion.turns, float)[frames])
    joints = _add_joints(glb, name, skin, quaternions[0], motion.root[frames[0]])
    mesh = glb.part("meshes", _mesh(glb, name, rgb, skin, motion.target_weights[frames[0]]))
    inverse = np.tile(np.eye(4), (len(skin.joints), 1, 1))
    inverse[:, 3, :3] = -np.asarray(skin.joints)  # Columns come one after the other.
    binds = glb.store(inverse.reshape(-1, 16))
    bones = glb.part("skins", {"name": name, "inverseBindMatrices": binds, "joints": joints})
    node = glb.node(name=name, mesh=mesh, skin=bones)
    times = glb.times(motion.time_s[frames])
    for joint, turns in zip(joints, np.moveaxis(quaternions, 1, 0), strict=True):
        glb.animate(joint, "rotation", times, turns)
    glb.animate(joints[0], "translation", times, motion.root[frames])
    if len(skin.targets):
        glb.animate(node, "weights", times, motion.target_weights[frames].ravel())
    changes, shown = visibility(motion.seen)
    if len(changes) > 1 or not shown[0]:
        scale = np.repeat(shown[:, None], 3, 1)
        glb.nodes[joints[0]]["scale"] = scale[0].astype(float).tolist()
        glb.animate(joints[0], "scale", glb.times(motion.time_s[changes]), scale, steps=True)
    return node, joints[0]


def _add_joints(glb: Glb, name: str, skin: Skin, first: Array, root: Array) -> list[int]:
    """Add the skeleton as it stands in the first frame; return its nodes."""
    nodes = []
    for joint, (label, parent) in enumerate(zip(skin.joint_names, skin.parents, strict=True)):
        place = root if parent < 0 else skin.joints[joint] - skin.joints[parent]
        content = {"translation": _floats(place), "rotation": _floats(first[joint])}
        nodes.append(glb.node(name=f"{name}_{label}", **content))
        if parent >= 0:
            glb.nodes[nodes[parent]].setdefault("children", []).append(nodes[joint])
    return nodes


def _mesh(glb: Glb, name: str, rgb: tuple[int, int, int], skin: Skin, weights: Array) -> dict:
    indices, pull = strongest(skin.weights)
    attributes = {
        "POSITION": glb.store(np.asarray(skin.vertices, np.float32), VERTEX_TARGET),
        "NORMAL": glb.store(_normals(skin), VERTEX_TARGET),
        "JOINTS_0": glb.store(indices, VERTEX_TARGET),
        "WEIGHTS_0": glb.store(pull, VERTEX_TARGET),
    }
    primitive = {
        "attributes": attributes,
        "indices": glb.triangles(skin.faces),
        "material": glb.material(rgb),
    }
    mesh = {"name": name, "primitives": [primitive]}
    if len(skin.targets):
        targets = [glb.store(np.asarray(target, np.float32), VERTEX_TARGET) for target in skin.targets]
        primitive["targets"] = [{"POSITION": target} for target in targets]
        mesh["weights"] = _floats(weights)
        mesh["extras"] = {"targetNames": [f"correction_{index}" for index in range(len(targets))]}
    return mesh


def strongest(weights: Float[Array, "vert joint"]) -> tuple[Array, Array]:
    """Return the four strongest joints of each vertex (uint8) and their weights (float32), which add up to 1.

    A joint without weight is called 0, as the standard wants it.
    """
    order = np.argsort(-np.asarray(weights), axis=1, kind="stable")[:, :_INFLUENCES]
    pull = np.take_along_axis(np.asarray(weights, np.float64), order, 1)
    pull = np.clip(pull, 0, None)
    pull = (pull / pull.sum(1, keepdims=True)).astype(np.float32)
    pull[:, 0] = 1 - pull[:, 1:].sum(1)
    return np.where(pull > 0, order, 0).astype(np.uint8), pull


def _normals(skin: Skin) -> Float[Array, "vert 3"]:
    import trimesh

    mesh = trimesh.Trimesh(np.asarray(skin.vertices, float), np.asarray(skin.faces), process=False)
    return np.asarray(mesh.vertex_normals, np.float32)


def _continuous(wxyz: Float[Array, "frame joint 4"]) -> Float[Array, "frame joint 4"]:
    """Return quaternions as x, y, z, w, of the sign that is nearer to the one before."""
    agree = (wxyz[1:] * wxyz[:-1]).sum(-1, keepdims=True)
    signs = np.cumprod(np.where(agree < 0, -1.0, 1.0), axis=0)
    return np.concatenate([wxyz[:1], wxyz[1:] * signs])[..., [1, 2, 3, 0]]


def _floats(values: Array) -> list[float]:
    return np.asarray(values, float).tolist()
