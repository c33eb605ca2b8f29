"""The released POEM v1, its ablations and the baselines through the public door: `convert`, `apply`, `infer`,
and out again, on procedural weights."""

from typing import Any

import jax
import numpy as np
import pytest

from poem_jax.models.apply import apply
from poem_jax.models.config import ModelConfig
from poem_jax.models.infer import infer, prepare
from poem_jax.models.presets import PRESETS, released
from poem_jax.typing import Params
from poem_jax.weights.store import load, save
from poem_jax.weights.torch_import import convert, export_state_dict
from tests.weights.v1_procedural import (
    REFERENCE_V1,
    batch_of,
    golden,
    manifest,
    needs_reference_v1,
    state_dict,
)

pytestmark = [needs_reference_v1, pytest.mark.parity]

VARIANTS = {
    "poem": "v1",
    "poem_g": "v1-g-emb",
    "poem_gv": "v1-gv-emb",
    "poem_full": "v1-full-emb",
    "poem_woproj": "v1-wo-proj",
    "petr": "pe-meshtr",
    "ftl": "ftl-meshtr",
    "mvp4": "mvp",
    "mvp8": "mvp",
}
"""The reference's names, and those that `convert` knows."""
VIEWS = {"mvp4": 4}
FARTHEST_M = 5e-6
"""Of PE-MeshTR, FTL-MeshTR and MvP."""
GATES_M = {50: 2e-5, 99: 3e-4, 100: 3e-3}
"""Of POEM v1, by percentile: neighbours at like distances change places."""


def imported(model: str, **changed: Any) -> tuple[ModelConfig, Params]:
    options = {"mano": REFERENCE_V1 / "fake_mano.npz", "num_views": VIEWS.get(model, 8), **changed}
    return convert(state_dict(model), VARIANTS[model], **options)


@pytest.mark.parametrize("model", VARIANTS)
def test_a_checkpoint_comes_in_and_goes_out_whole(model: str) -> None:
    config, params = imported(model)
    assert config == released(VARIANTS[model], num_views=VIEWS.get(model, 8))
    back, state = export_state_dict(config, params), state_dict(model)
    assert back.keys() == state.keys()
    for entry in manifest(model):
        assert back[entry.name].shape == entry.shape
        assert back[entry.name].dtype == entry.dtype
        if entry.used and entry.hand_field is None:
            np.testing.assert_array_equal(back[entry.name], state[entry.name], err_msg=entry.name)


@pytest.mark.parametrize("model", VARIANTS)
def test_the_public_door_gives_what_the_release_gave(model: str) -> None:
    case = "a" if model == "mvp4" else "b"
    stored, batch = golden(f"{model}_{case}"), batch_of(case)
    config, params = imported(model)
    given = {"ball_index": stored["ball_index"]} if "ball_index" in stored else {}
    found = apply(params, batch.views, batch.cameras, config=config, **given)
    wanted = np.moveaxis(stored["all_coords_preds"], 0, 1)
    distances = np.linalg.norm(np.asarray(found.layers_world, float) - wanted, axis=-1)
    by_percentile = {q: float(np.percentile(distances[:, -1], q)) for q in GATES_M}
    print(model, case, by_percentile, "all layers", distances.max())
    gates = GATES_M if given else dict.fromkeys(GATES_M, FARTHEST_M)
    assert all(by_percentile[q] <= gate for q, gate in gates.items()), by_percentile
    if given:
        np.testing.assert_allclose(found.keypoints_px, stored["pred_joints_uv"], atol=1e-2)
        np.testing.assert_allclose(found.reference_joints_world, stored["pred_ref_joints_3d"], atol=1e-5)
    else:
        assert found.root_world is found.keypoints_px is found.reference_joints_world is None


def test_infer_takes_the_injected_points_too() -> None:
    stored, batch = golden("poem_b"), batch_of("b")
    config, params = imported("poem")
    found = infer(prepare(params, config), batch.views, batch.cameras, ball_index=stored["ball_index"])
    distances = np.linalg.norm(found.layers_world[:, -1] - stored["all_coords_preds"][-1], axis=-1)
    assert all(np.percentile(distances, q) <= gate for q, gate in GATES_M.items())


def test_data_sets_and_folders(tmp_path) -> None:
    config, params = imported("petr", dataset="oakink")
    assert config == released("pe-meshtr", dataset="oakink") != PRESETS["pe-meshtr-release"]
    save(tmp_path / "model", config, params)
    again, stored = load(tmp_path / "model")
    assert again == config
    jax.tree.map(np.testing.assert_array_equal, stored, params)
    assert imported("poem", dataset="ho3d")[0] == PRESETS["v1-release-ho3d"]


def test_checkpoints_of_others_are_named() -> None:
    with pytest.raises(ValueError, match=r"does not fit v1: .*looks like v1-g-emb: pass that variant"):
        convert(state_dict("poem_g"), "v1", mano=REFERENCE_V1 / "fake_mano.npz")
    hint = r"does not fit mvp: .*not of `num_views` = 5\? It looks made for 4 views"
    with pytest.raises(ValueError, match=hint):
        imported("mvp4", num_views=5)
