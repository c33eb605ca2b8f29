"""Make the hand that ships: `python tools/make_hand.py [--out poem_jax/hand/template.npz]`.

Everything is computed from the measures in `hand_design/anatomy.py` and `surface.py`; the result is the
same on every run. `tools/measure_hand.py` checks it and draws the picture of the docs.
"""

import argparse
from pathlib import Path

import numpy as np
from hand_design.anatomy import SKELETON, to_mano_axes, vectors_to_mano_axes
from hand_design.correctives import pose_directions
from hand_design.mesh import Mesh, build_mesh
from hand_design.shapes import shape_directions
from hand_design.skin import MANO_FINGERS, joint_regressor, skeleton, skin_weights

ROOT = Path(__file__).resolve().parents[1]
# Slots of the pole and of neighbours on the tip, per finger: MANO's tip vertices.
_TIP_SLOTS = {
    "thumb": (745, 744),
    "index": (317, 320),
    "middle": (444, 443, 445),
    "ring": (556, 555),
    "little": (673, 672),
}
_BLOCKS = ("index", "middle", "ring", "little", "thumb")


def numbering(mesh: Mesh) -> np.ndarray:
    """Return the order of vertices in the file: palm, then fingers, with tips where MANO has them."""
    order = np.full(len(mesh.vertices), -1)
    for name, slots in _TIP_SLOTS.items():
        order[list(slots)] = mesh.tips[name][: len(slots)]
    blocks = [np.concatenate([mesh.rings[n][1:].ravel(), mesh.tips[n]]) for n in _BLOCKS]
    palm = np.setdiff1d(np.arange(len(order)), np.concatenate(blocks))
    rest = np.concatenate([palm, *blocks])
    order[order < 0] = rest[~np.isin(rest, order)]
    return order


def outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Turn all faces over if the mesh is inside out."""
    a, b, c = (vertices[faces[:, k]] - vertices.mean(axis=0) for k in range(3))
    return faces if np.einsum("ij,ij->", np.cross(a, b), c) > 0 else faces[:, ::-1]


def bending_axes() -> np.ndarray:
    """(15, 3, 3) in MANO's axes: flexion, abduction and twist of every bending joint, unit rows."""
    axes = []
    for name in MANO_FINGERS:
        finger = SKELETON[name]
        nail = vectors_to_mano_axes(finger.dorsal)
        for bone in vectors_to_mano_axes(np.diff(finger.joints, axis=0)):
            twist = bone / np.linalg.norm(bone)
            abduction = nail - twist * (nail @ twist)
            abduction /= np.linalg.norm(abduction)
            axes.append([np.cross(abduction, twist), abduction, twist])
    return np.array(axes)


def make_template() -> dict[str, np.ndarray]:
    """Return the arrays of the shipped file, under MANO's names."""
    mesh = build_mesh()
    order = numbering(mesh)
    place = np.argsort(order)
    regressor = joint_regressor(mesh.vertices, skeleton())
    directions = shape_directions(mesh.vertices, skin_weights(mesh, spread=2.0))
    vertices = to_mano_axes(mesh.vertices)[order]
    weights = skin_weights(mesh)[order]
    joints = regressor[:, order] @ vertices
    shapedirs = np.moveaxis(vectors_to_mano_axes(np.moveaxis(directions, 1, -1)), -1, 1) * 1e-3
    return {
        "v_template": vertices.astype(np.float32),
        "shapedirs": shapedirs[order].astype(np.float32),
        "posedirs": pose_directions(vertices, weights, joints, bending_axes(), 0.8).astype(np.float32),
        "J_regressor": regressor[:, order].astype(np.float32),
        "weights": weights.astype(np.float32),
        "faces": outward(vertices, place[mesh.faces]).astype(np.uint16),
    }


def main() -> None:
    """Write the template."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "poem_jax/hand/template.npz")
    arguments = parser.parse_args()
    arrays = make_template()
    np.savez_compressed(arguments.out, **arrays)
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
