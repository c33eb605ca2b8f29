"""The take that ships: four videos of two moving hands, their calibration file, and the truth.

A person above a desk, three seconds, rendered by `poem_jax.synthetic.desk`; made by `tools/make_demo.py`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.evaluation.metrics import evaluate
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_SHAPES
from poem_jax.typing import Array, Float

TRUTH = "truth.npz"


class Truth(NamedTuple):
    """Where the hands are: metres, the world of the calibration file."""

    sides: tuple[str, ...]
    """Of the hands, 'left' or 'right'."""
    vertices_world: Float[Array, "frame hand 778 3"]
    joints_world: Float[Array, "frame hand 21 3"]


class DemoScore(NamedTuple):
    """How far the reconstruction is from the truth."""

    mpvpe_mm: float
    """Mean distance of the vertices of all hands that were found, millimetres."""
    mpjpe_mm: float
    found: int
    """Hands that were found, in all frames together."""
    of: int
    """Hands that there are."""


def demo_folder() -> Path:
    """Return the folder with four videos, `calibration.toml` and `truth.npz`."""
    return Path(__file__).parent


def demo_truth() -> Truth:
    """Return the true hands; the file holds poses, the shipped hand makes meshes of them."""
    with np.load(demo_folder() / TRUTH) as stored:
        sides = tuple(map(str, stored["hand_side"]))
        pose, place = stored["pose"], stored["translation"]
        shape = np.broadcast_to(stored["shape"], (len(pose), NUM_SHAPES))
    meshes = [hand_mesh(default_hand(side), pose[:, h], shape, place[:, h]) for h, side in enumerate(sides)]
    vertices, joints = (
        np.stack([np.asarray(getattr(mesh, name)) for mesh in meshes], axis=1)
        for name in ("vertices", "joints")
    )
    return Truth(sides, vertices, joints)


def demo_score(arrays: Mapping[str, Array], hand_names: Sequence[str]) -> DemoScore:
    """Compare a reconstruction of the demo with the truth; a hand is compared with the true one of its side.

    Args:
        arrays: `vertices_world` and `joints_world` as in `prediction.npz`; NaN = not found.
        hand_names: Of its hands, as in `report.json`: their sides, numbered where one comes twice.

    Raises:
        ValueError: No true hand was found in any frame.
    """
    truth = demo_truth()
    pairs = [(hand_names.index(side), h) for h, side in enumerate(truth.sides) if side in hand_names]
    ours, true = (list(index) for index in zip(*pairs, strict=True)) if pairs else ([], [])
    joints, vertices = (arrays[name][:, ours] for name in ("joints_world", "vertices_world"))
    found = np.isfinite(vertices).all((-1, -2))
    if not found.any():
        raise ValueError("none of the demo's hands was found: there is nothing to compare with the truth")
    gt_joints, gt_vertices = truth.joints_world[:, true], truth.vertices_world[:, true]
    scores = evaluate(joints[found], gt_joints[found], vertices[found], gt_vertices[found], protocol="poem")
    count = truth.joints_world.shape[:2]
    return DemoScore(scores["mpvpe_mm"], scores["mpjpe_mm"], int(found.sum()), count[0] * count[1])
