"""The released models with weights drawn from their parameters' names, and the inputs of the golden cases."""

import functools
import hashlib
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.models.config import Config
from poem_jax.typing import Params
from poem_jax.weights.torch_import import convert

REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "reference" / "poem_v2"
needs_reference = pytest.mark.skipif(
    not REFERENCE.is_dir(), reason="reference material (../shared) is not on this machine"
)

VARIANTS = {"small": "v2-small", "medium": "v2-medium", "large": "v2-large", "medium_MANO": "v2-medium-mano"}
"""The released models: the reference's names, and those that `convert` knows."""

IMAGE_HW = (256, 256)


class ManifestEntry(NamedTuple):
    """One array of a released state dict."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    used: bool
    """Whether an output depends on it."""

    @property
    def hand_field(self) -> str | None:
        """Which part of a MANO asset it holds, if any."""
        return self.name.rpartition("mano_layer.th_")[2] if "mano_layer.th_" in self.name else None


@functools.cache
def manifest(model: str) -> tuple[ManifestEntry, ...]:
    entries = json.loads((REFERENCE / f"manifest_{model}.json").read_text())["entries"]
    return tuple(
        ManifestEntry(e["name"], tuple(e["shape"]), np.dtype(e["dtype"]), e["used"]) for e in entries
    )


def weight(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Draw the procedural array of a name."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    z = np.random.Generator(np.random.PCG64(seed)).standard_normal(shape)
    kind, scale = _rule(name, len(shape))
    return _KINDS[kind](z, scale).astype(np.float32)


def _rule(name: str, ndim: int) -> tuple[str, Any]:
    for pattern, kind, scale in _rules():
        if pattern.search(name):
            return kind, scale
    if ndim >= 2:
        return "fan", 2**0.5 if ndim == 4 else 1.0
    return ("gain", 1.0) if name.endswith("weight") else ("normal", 0.02)


@functools.cache
def _rules() -> list[tuple[re.Pattern, str, Any]]:
    rules = json.loads((REFERENCE / "weight_rule.json").read_text())["rules"]
    return [(re.compile(pattern), kind, scale) for pattern, kind, scale in rules]


def _around_identities(z: np.ndarray, s: float) -> np.ndarray:
    """Sixteen rotations in 6D near the identity, and what follows them."""
    v = s * z
    v[:96] += np.tile([1, 0, 0, 0, 1, 0], 16)
    return v


def _fan(z: np.ndarray, s: float) -> np.ndarray:
    v = z * s / np.sqrt(np.prod(z.shape[1:]))
    return v - v.mean((1, 2, 3), keepdims=True) if z.ndim == 4 else v


_KINDS: dict[str, Callable] = {
    "normal": lambda z, s: s * z,
    "gain": lambda z, s: s * (1 + 0.1 * z),
    "1+abs": lambda z, s: 1 + s * np.abs(z),
    "zero": lambda z, s: 0 * z,
    "shift": lambda z, s: s[0] + s[1] * z,
    "sixd": _around_identities,
    "fan": _fan,
}


def state_dict(model: str, draw: Callable[[str, tuple[int, ...]], np.ndarray] = weight) -> dict[str, Any]:
    """Return a model's arrays by name: `draw` gives the used weights, the others are zero."""
    return {entry.name: _array(entry, draw) for entry in manifest(model)}


def _array(entry: ManifestEntry, draw: Callable) -> np.ndarray:
    if entry.hand_field in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "faces"):
        field = "f" if entry.hand_field == "faces" else entry.hand_field
        return hand_asset()[field].astype(entry.dtype).reshape(entry.shape)
    if entry.hand_field or not entry.used:
        return np.zeros(entry.shape, entry.dtype)
    return draw(entry.name, entry.shape)


@functools.cache
def hand_asset() -> dict[str, np.ndarray]:
    return dict(np.load(REFERENCE / "fake_mano.npz"))


def constants() -> dict[str, Any]:
    """Return what `convert` needs beside a state dict."""
    files = {"basis_points": "bps", "anchor_points": "anchor", "anchor_indices": "anchor_idx"}
    arrays = {name: np.load(REFERENCE / f"{file}.npy") for name, file in files.items()}
    return {"mano": REFERENCE / "fake_mano.npz", **arrays}


@functools.lru_cache(maxsize=1)
def released(model: str) -> tuple[Config, Params]:
    """Return a released model with procedural weights."""
    return convert(state_dict(model), VARIANTS[model], **constants())


@functools.cache
def inputs(case: str) -> dict[str, np.ndarray]:
    return dict(np.load(REFERENCE / f"inputs_{case}.npz"))


@functools.cache
def golden(file: str) -> dict[str, np.ndarray]:
    """Read stored outputs; points of all blocks become (batch, layer, 799, 3), as in `Prediction`."""
    stored = dict(np.load(REFERENCE / f"golden_{file}.npz"))
    return {k: np.moveaxis(v, 0, 1) if "all_coords_preds" in k else v for k, v in stored.items()}


def batch_of(case: str) -> MultiViewBatch:
    """Return the samples of a case; the world is each master camera's frame."""
    return stack_samples(list(samples(case)))


def samples(case: str) -> Iterator[MultiViewBatch]:
    """Yield the samples of a case, without batch axis and without padded views."""
    data = inputs(case)
    ends = np.cumsum(data["views"])
    for b, (end, count) in enumerate(zip(ends, data["views"], strict=True)):
        views = slice(end - count, end)
        T_cam_from_world = np.linalg.inv(data["target_cam_extr"][views].astype(np.float64))
        yield MultiViewBatch(
            views=data["image_u8"][views],
            cameras=Cameras(data["target_cam_intr"][views], T_cam_from_world, np.ones(count, bool)),
            joints_world=data["master_joints_3d"].reshape(-1, 21, 3)[b],
            vertices_world=data["master_verts_3d"].reshape(-1, 778, 3)[b],
            keypoints_px=data["target_joints_2d"][views],
            pose=data["mano_pose"][end - count],
            shape=data["mano_shape"][end - count],
        )


def stack_samples(parts: list[MultiViewBatch], num_views: int | None = None) -> MultiViewBatch:
    """Make a batch of samples, padded with empty views to the most views that one has, or to `num_views`."""
    padded = [pad_views(part, num_views or max(len(p.views) for p in parts)) for part in parts]
    fields = zip(*padded, strict=True)
    return MultiViewBatch(*(None if f[0] is None else _stacked(f) for f in fields))


def _stacked(values: tuple) -> Any:
    if isinstance(values[0], Cameras):
        return Cameras(*map(np.stack, zip(*values, strict=True)))
    return np.stack(values)


def pad_views(sample: MultiViewBatch, num_views: int) -> MultiViewBatch:
    """Append empty views to one sample."""
    missing = num_views - len(sample.views)

    def pad(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.zeros((missing, *values.shape[1:]), values.dtype)])

    return sample._replace(
        views=pad(sample.views),
        cameras=Cameras(*map(pad, sample.cameras)),
        keypoints_px=pad(sample.keypoints_px),
    )


def in_float32(batch: MultiViewBatch) -> MultiViewBatch:
    """Round the extrinsics, which come as float64, for functions that do not move far worlds first."""
    K, T_cam_from_world, mask = batch.cameras
    return batch._replace(cameras=Cameras(K, T_cam_from_world.astype(np.float32), mask))


def known_root(batch: MultiViewBatch) -> np.ndarray | None:
    """Return the true root where the release takes it: if every sample has one view."""
    return batch.joints_world[:, ROOT_JOINT] if batch.views.shape[1] == 1 else None
