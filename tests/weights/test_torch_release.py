"""The released networks in PyTorch (`benchmarks/torch_release`), on procedural weights, against what the
authors' code stored: they are what our speed is compared with, so they must be the release."""

import functools

import numpy as np
import pytest

from poem_jax.hand import mano_file
from poem_jax.hand.model import template_queries
from poem_jax.hand.topology import QueryOrder
from tests.weights import procedural, v1_procedural

torch = pytest.importorskip("torch")

from benchmarks.torch_release import v1, v2  # noqa: E402
from benchmarks.torch_release.layers import as_images, load_released  # noqa: E402

pytestmark = [procedural.needs_reference, pytest.mark.parity]

KEYPOINT_PX, JOINT_M, FIRST_BLOCK_M = 1e-3, 1e-5, 1e-5
V2_GATES_M = {98: 2e-5, 100: 5e-3}
V1_GATES_M = {50: 2e-5, 99: 3e-4, 100: 3e-3}
"""Percentiles of the distances of the points: neighbours at like distances change places."""
FORMATS = {"nchw": torch.contiguous_format, "channels_last": torch.channels_last}


def assert_within(distance: np.ndarray, gates: dict[float, float]) -> None:
    found = {q: float(np.percentile(distance, q)) for q in gates}
    print(found)
    assert all(found[q] <= gate for q, gate in gates.items()), found


@functools.lru_cache(maxsize=1)
def released_v2(form: str) -> v2.PoemV2:
    constants = procedural.constants()
    hand = mano_file.load(constants.pop("mano"), "right")
    template = np.asarray(template_queries(hand, QueryOrder.JOINTS_FIRST), np.float32)
    model = v2.PoemV2(v2.Constants.of(constants | {"template": template})).eval()
    load_released(model, procedural.state_dict("medium"))
    return model.to(memory_format=FORMATS[form])


def test_v2_has_the_arrays_that_its_outputs_depend_on() -> None:
    used = {e.name for e in procedural.manifest("medium") if e.used and e.hand_field is None}
    own = {name for name in released_v2("nchw").state_dict() if not name.endswith("num_batches_tracked")}
    assert own == used


@pytest.mark.parametrize("case", "ABC")
@pytest.mark.parametrize("form", FORMATS)
def test_v2_is_the_release(form: str, case: str) -> None:
    data, stored = procedural.inputs(case), procedural.golden(f"medium_{case}")
    cams = (torch.from_numpy(data[name]) for name in ("target_cam_intr", "target_cam_extr"))
    joints = torch.from_numpy(data["master_joints_3d"].reshape(-1, 21, 3))
    images = as_images(data["image_u8"], FORMATS[form])
    with torch.inference_mode():
        found = released_v2(form)(images, *cams, data["views"].tolist(), joints)
    np.testing.assert_allclose(found.keypoints_px, stored["pred_joints_uv"], rtol=0, atol=KEYPOINT_PX)
    np.testing.assert_allclose(found.reference_joints, stored["pred_ref_joints_3d"], rtol=0, atol=JOINT_M)
    theirs = np.moveaxis(stored["all_coords_preds"], 1, 0)
    first, *later = np.linalg.norm(found.layers.numpy() - theirs, axis=-1)
    assert first.max() <= FIRST_BLOCK_M
    for distance in later:
        assert_within(distance, V2_GATES_M)


@functools.lru_cache(maxsize=1)
def released_v1(form: str) -> v1.PoemV1:
    model = v1.PoemV1().eval()
    load_released(model, v1_procedural.state_dict("poem"))
    return model.to(memory_format=FORMATS[form])


def test_v1_has_the_arrays_that_its_outputs_depend_on() -> None:
    used = {e.name for e in v1_procedural.manifest("poem") if e.used and e.hand_field is None}
    own = {name for name in released_v1("nchw").state_dict() if not name.endswith("num_batches_tracked")}
    assert own == used


@pytest.mark.parametrize("case", "ab")
@pytest.mark.parametrize("form", FORMATS)
def test_v1_is_the_release(form: str, case: str) -> None:
    data, stored = v1_procedural.inputs(case), v1_procedural.golden(f"poem_{case}")
    cams = (torch.from_numpy(data[name]) for name in ("target_cam_intr", "target_cam_extr"))
    images = as_images(np.moveaxis(data["image_u8"], 2, -1).reshape(-1, 256, 256, 3), FORMATS[form])
    with torch.inference_mode():
        found = released_v1(form)(images, *cams, torch.from_numpy(stored["ball_index"]).long())
    np.testing.assert_allclose(found.keypoints_px, stored["pred_joints_uv"], rtol=0, atol=KEYPOINT_PX)
    np.testing.assert_allclose(found.reference_joints, stored["pred_ref_joints_3d"], rtol=0, atol=JOINT_M)
    for distance in np.linalg.norm(found.layers.numpy() - stored["all_coords_preds"], axis=-1):
        assert_within(distance, V1_GATES_M)


def test_v1_draws_basis_points_of_the_ball() -> None:
    grid, centre = torch.rand(2, 2, 8, 8, 32, 3) * 0.3, torch.tensor([[0.1, 0.2, 0.1], [9, 9, 9]])
    points = v1.basis_points(grid, centre, None)
    assert points.shape == (2, 4096, 3)
    inside = grid[0].reshape(-1, 3)
    inside = inside[((inside - centre[0]) ** 2).sum(-1) < 0.2**2]
    held = {tuple(point) for point in inside.tolist()}
    drawn = {tuple(point) for point in points[0].tolist()} - {(0.0, 0.0, 0.0)}
    assert drawn <= held
    assert len(drawn) == min(len(held), 4096)
    assert not points[1].any()
