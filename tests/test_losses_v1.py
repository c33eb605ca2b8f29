"""The losses of POEM v1, PE-MeshTR, FTL-MeshTR and MvP, and their metrics, on outputs that the released code
stored."""

import json
from pathlib import Path

import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.evaluation.metrics import evaluate, point_distances
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand import mano_file
from poem_jax.hand.model import HandModel, joints_from_vertices
from poem_jax.hand.topology import QueryOrder
from poem_jax.losses import MESH_TRANSFORMER, MVP, V1, LossRecipe, multi_view_losses

REFERENCE = Path(__file__).resolve().parents[2] / "shared" / "reference" / "poem_v1"
pytestmark = [
    pytest.mark.parity,
    pytest.mark.skipif(
        not REFERENCE.is_dir(), reason="reference material (../shared) is not on this machine"
    ),
]

RECIPES = {"poem": V1, "petr": MESH_TRANSFORMER, "ftl": MESH_TRANSFORMER, "mvp": MVP}
TERMS = {
    "joints": "loss_3d_joints",
    "regressed_joints": "loss_3d_joints_from_mesh",
    "vertices": "loss_3d_verts",
    "reprojection": "loss_2d_joints",
    "vertex_reprojection": "loss_2d_verts",
    "keypoints": "loss_heatmap_joints",
    "triangulation": "loss_triangulated_joints",
}
FILES = sorted(path.stem.removeprefix("golden_") for path in REFERENCE.glob("golden_*_[ab].npz"))


def recipe_of(file: str) -> LossRecipe:
    return next(recipe for name, recipe in RECIPES.items() if file.startswith(name))


def hand() -> HandModel:
    return mano_file.load(REFERENCE / "fake_mano.npz")


def case(file: str) -> tuple[Prediction, MultiViewBatch, dict[str, np.ndarray]]:
    stored, data = (
        dict(np.load(REFERENCE / f"golden_{file}.npz")),
        np.load(REFERENCE / f"inputs_{file[-1]}.npz"),
    )
    layers = np.moveaxis(stored["all_coords_preds"], 0, 1)
    T_cam_from_world = np.linalg.inv(data["target_cam_extr"].astype(np.float64)).astype(np.float32)
    mask = np.ones(T_cam_from_world.shape[:2], bool)
    truth = MultiViewBatch(
        views=np.zeros((*mask.shape, 1, 1, 3), np.uint8),
        cameras=Cameras(data["target_cam_intr"], T_cam_from_world, mask),
        joints_world=data["master_joints_3d"],
        vertices_world=data["master_verts_3d"],
        keypoints_px=data["target_joints_2d"],
    )
    prediction = Prediction(
        vertices_world=layers[:, -1, 21:],
        joints_world=layers[:, -1, :21],
        root_world=None,
        keypoints_px=stored.get("pred_joints_uv"),
        layers_world=layers,
        valid=np.ones(len(layers), bool),
        reference_joints_world=stored.get("pred_ref_joints_3d"),
    )
    return prediction, truth, stored


@pytest.mark.parametrize("file", FILES)
def test_every_stored_loss_comes_out(file: str) -> None:
    prediction, batch, stored = case(file)
    recipe, options = recipe_of(file), {"hand": hand(), "image_hw": (256, 256)}
    options["query_order"] = QueryOrder.JOINTS_FIRST
    loss, terms = multi_view_losses(prediction, batch, recipe=recipe, **options)
    wanted = {name.removeprefix("loss/"): value for name, value in stored.items() if name.startswith("loss/")}
    got = {TERMS[name]: term for name, term in terms.items()} | {"loss": loss}
    got["loss_recon"] = sum(
        getattr(recipe, name) * terms[name]
        for name in terms
        if name in TERMS
        and name
        not in (
            "keypoints",
            "triangulation",
        )
    )
    for i in range(prediction.layers_world.shape[1]):
        layer = prediction._replace(
            vertices_world=prediction.layers_world[:, i, 21:], joints_world=prediction.layers_world[:, i, :21]
        )
        _, of_layer = multi_view_losses(layer, batch, recipe=recipe, **options)
        got[f"dec{i}_loss_recon"] = sum(
            getattr(recipe, name) * of_layer[name]
            for name in of_layer
            if name not in ("keypoints", "triangulation")
        )
    assert got.keys() == wanted.keys()
    for name, value in wanted.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-4, err_msg=name)


@pytest.mark.parametrize("file", FILES)
def test_every_stored_metric_comes_out(file: str) -> None:
    """POEM's are of joints regressed from both meshes, the others' of the joints given; all in metres."""
    prediction, batch, _ = case(file)
    wanted = json.loads((REFERENCE / "metrics.json").read_text())[file]
    points = (prediction.joints_world, batch.joints_world, prediction.vertices_world, batch.vertices_world)
    is_poem, asset = file.startswith("poem"), hand()
    scores = evaluate(*points, protocol="poem-release" if is_poem else "poem", hand=asset)
    names = {
        "MPJPE_3D": "mpjpe_mm",
        "MPVPE_3D": "mpvpe_mm",
        "MPJPE_3D_REL": "rr_mpjpe_mm",
        "MPVPE_3D_REL": "rr_mpvpe_mm",
        "PA/pa_mpjpe": "pa_mpjpe_mm",
        "PA/mpjpe": "mpjpe_mm",
        "PA/pa_mpvpe": "pa_mpvpe_mm",
        "PA/mpvpe": "mpvpe_mm",
    }
    got = {name: scores[ours] / 1000 for name, ours in names.items()}
    if prediction.reference_joints_world is not None:
        regressed = np.asarray(joints_from_vertices(asset, batch.vertices_world))
        got["MPJPE_3D_REF"] = point_distances(prediction.reference_joints_world, regressed).mean()
        got["MPTPE_3D"] = point_distances(prediction.reference_joints_world, batch.joints_world).mean()
    assert got.keys() == wanted.keys()
    for name, value in wanted.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-4, err_msg=name)
