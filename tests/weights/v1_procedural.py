"""The released v1 models (POEM v1, its ablations, the baselines) with weights drawn from their parameters'
names, and the inputs of the golden cases."""

import functools
import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.batch import MultiViewBatch
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand import mano_file
from poem_jax.hand.model import HandModel
from poem_jax.weights.name_table import NameRow, read_rows

REFERENCE_V1 = Path(__file__).resolve().parents[3] / "shared" / "reference" / "poem_v1"
needs_reference_v1 = pytest.mark.skipif(
    not REFERENCE_V1.is_dir(), reason="reference material (../shared) is not on this machine"
)

MODELS = ("poem", "poem_g", "poem_gv", "poem_full", "poem_woproj", "petr", "ftl", "mvp4", "mvp8")
"""The reference's names of the models, one manifest each."""
CASES = {"mvp4": ("a",), "mvp8": ("b",)}
"""Input sets of the models that are tied to a number of cameras; the others ran on both."""

_HAND = "mano_layer."


class ManifestEntry(NamedTuple):
    """One array of a released state dict."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    used: bool
    """Whether an output depends on it."""
    kind: str
    """param, bn_stat, frozen_bn_affine, frozen_bn_stat, counter or mano_asset."""
    alias_of: str | None
    """The first name of the same array, if it has another."""
    sha256_16: str | None

    @property
    def hand_field(self) -> str | None:
        """Which part of a MANO asset it holds, if any."""
        return self.name.rpartition("th_")[2] if _HAND in self.name else None


@functools.cache
def _manifest_file(model: str) -> dict[str, Any]:
    return json.loads((REFERENCE_V1 / f"manifest_{model}.json").read_text())


@functools.cache
def manifest(model: str) -> tuple[ManifestEntry, ...]:
    """List a model's state dict in its order."""
    return tuple(
        ManifestEntry(
            e["name"],
            tuple(e["shape"]),
            np.dtype(e["dtype"]),
            e["used_in_eval_forward"],
            e["kind"],
            e.get("alias_of"),
            e.get("sha256_16"),
        )
        for e in _manifest_file(model)["entries"]
    )


def weight(model: str, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Draw the procedural array of a canonical name, by the table of the model's manifest."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    z = np.random.Generator(np.random.PCG64(seed)).standard_normal(size=shape)
    kind, scale = _rule(model, name, len(shape))
    return np.asarray(_KINDS[kind](z, scale), np.float32)


def _rule(model: str, name: str, ndim: int) -> tuple[str, Any]:
    for pattern, kind, scale in _table(model):
        if pattern.search(name):
            return kind, scale
    if ndim >= 2:
        return "fan", 2**0.5 if ndim == 4 else 1.0
    return ("gain", 1.0) if ndim == 1 and name.endswith("weight") else ("normal", 0.02)


@functools.cache
def _table(model: str) -> list[tuple[re.Pattern, str, Any]]:
    return [(re.compile(p), kind, scale) for p, kind, scale in _manifest_file(model)["weight_rule"]["table"]]


_KINDS: dict[str, Callable] = {
    "normal": lambda z, s: s * z,
    "1+abs": lambda z, s: 1 + s * np.abs(z),
    "zero": lambda z, s: 0 * z,
    "gain": lambda z, s: s * (1 + 0.1 * z),
    "const+normal": lambda z, s: s[0] + s[1] * z,
    "unit": lambda z, s: 0.5 + s * np.clip(z, -1.7, 1.7),
    "fan": lambda z, s: z * s / np.sqrt(np.prod(z.shape[1:])),
}


@functools.lru_cache(maxsize=1)
def state_dict(model: str) -> dict[str, np.ndarray]:
    """Return a model's arrays by name, those that no output depends on too."""
    return {entry.name: _array(model, entry) for entry in manifest(model)}


def _array(model: str, entry: ManifestEntry) -> np.ndarray:
    if entry.hand_field is not None:
        return _hand_buffer(entry)
    return weight(model, entry.alias_of or entry.name, entry.shape).astype(entry.dtype)


def _hand_buffer(entry: ManifestEntry) -> np.ndarray:
    """Return what the hand layer of the release keeps; it has a flat hand, whatever the asset's mean."""
    fields = {"faces": "f", "selected_comps": "hands_components"}
    field = fields.get(entry.hand_field or "", entry.hand_field or "")
    if field in ("betas", "hands_mean"):
        return np.zeros(entry.shape, entry.dtype)
    array = hand_asset()[field]
    if field == "hands_components":
        array = array[: entry.shape[0]]
    return array.astype(entry.dtype).reshape(entry.shape)


@functools.cache
def hand_asset() -> dict[str, np.ndarray]:
    """Read the MANO-shaped asset of all runs; it is another than the one beside the v2 goldens."""
    with np.load(REFERENCE_V1 / "fake_mano.npz") as file:
        return dict(file)


@functools.cache
def hand() -> HandModel:
    """Return that asset as a hand."""
    return mano_file.load(REFERENCE_V1 / "fake_mano.npz", "right")


@functools.cache
def inputs(case: str) -> dict[str, np.ndarray]:
    """Read the arrays of case "a" (2 samples x 4 views) or "b" (1 x 8)."""
    with np.load(REFERENCE_V1 / f"inputs_{case}.npz") as file:
        return dict(file)


@functools.cache
def golden(file: str) -> dict[str, np.ndarray]:
    """Read the arrays of `golden_<file>.npz`, as stored."""
    with np.load(REFERENCE_V1 / f"golden_{file}.npz") as arrays:
        return dict(arrays)


@functools.cache
def batch_of(case: str) -> MultiViewBatch:
    """Return the samples of a case, images NHWC uint8; the world is each master camera's frame.

    The models' `image_mean` of 0.5 and `image_std` of 1 make float32(uint8) / 255 - 0.5 of the images.
    """
    data = inputs(case)
    T_cam_from_world = np.linalg.inv(data["target_cam_extr"].astype(np.float64))
    batch, view = T_cam_from_world.shape[:2]
    return MultiViewBatch(
        views=np.moveaxis(data["image_u8"], 2, -1),
        cameras=Cameras(data["target_cam_intr"], T_cam_from_world, np.ones((batch, view), bool)),
        joints_world=data["master_joints_3d"],
        vertices_world=data["master_verts_3d"],
        keypoints_px=data["target_joints_2d"],
        pose=data["mano_pose"].reshape(batch, 16, 3),
        shape=data["mano_shape"],
    )


def load_rows(model: nnx.Module, rows: list[NameRow], state: dict[str, np.ndarray]) -> None:
    """Put a released state dict into a model in place, by its table, which must fill every weight."""
    variables = {
        ".".join([group, *map(str, path)]): variable
        for group, kind in (("trainable", nnx.Param), ("statistics", nnx.BatchStat))
        for path, variable in nnx.to_flat_state(nnx.state(model, kind))
    }
    leaves, problems = read_rows(rows, state, {name: v.get_value() for name, v in variables.items()})
    assert not problems, problems[:5]
    assert leaves.keys() == variables.keys(), sorted(variables.keys() - leaves.keys())[:5]
    filled = [(name, variable.replace(jnp.asarray(leaves[name]))) for name, variable in variables.items()]
    by_path = ((tuple(_key(part) for part in name.split(".")[1:]), variable) for name, variable in filled)
    nnx.update(model, nnx.from_flat_state(by_path))


def _key(part: str) -> str | int:
    return int(part) if part.isdigit() else part


PLACES = (1, 2, 4, 7)
"""Where the four views of set a stand among 8; the others hold garbage."""


def amid_garbage(batch: MultiViewBatch) -> MultiViewBatch:
    """Put the four views of a batch at `PLACES` among 8 of which the others are masked."""
    rng, shape = np.random.default_rng(0), (len(batch.views), 8)
    views = rng.integers(0, 256, (*shape, *batch.views.shape[2:]), np.uint8)
    K, T = np.full((*shape, 3, 3), np.nan, np.float32), rng.normal(size=(*shape, 4, 4))
    mask, places = np.zeros(shape, bool), list(PLACES)
    views[:, places], mask[:, places] = batch.views, True
    K[:, places], T[:, places] = batch.cameras.K, batch.cameras.T_cam_from_world
    return batch._replace(views=views, cameras=Cameras(K, T, mask))
