"""Run a model on a fixed set of captures, with fewer and with more of their views.

The same captures are used for every view count, and n views are the first n of them, so that the rows of the
table differ in the number of cameras and in nothing else; the primary camera is the same throughout.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import numpy as np
from tqdm import tqdm

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.data.batching import collate, pad_batch, pad_views
from poem_jax.evaluation.baselines import mean_pose, mean_pose_rotated, noisy_dlt_roots
from poem_jax.evaluation.metrics import evaluate, point_distances
from poem_jax.evaluation.protocols import MM_PER_METRE, find_protocol
from poem_jax.evaluation.systems import Answer, System
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.models.apply import apply
from poem_jax.models.config import ModelConfig
from poem_jax.typing import Array, Params

DEFAULT_SEED = 20261122
"""Of the captures, where the caller names none; no training seed."""
MAX_VIEWS = 8

Scores = dict[str, float | int | None]
"""Metrics of one view count; None where one cannot be had (a root from one view, or of a model without)."""


@runtime_checkable
class Captures(Protocol):
    """Where samples come from: `SyntheticDataset`, or anything like it."""

    def sample(self, index: int, num_views: int | None = None) -> MultiViewBatch:
        """Return a sample without batch axis, the first `num_views` of its views."""
        ...


@dataclass(frozen=True)
class BenchmarkSettings:
    """How many captures, which view counts, and which official definitions."""

    views: tuple[int, ...] = (2, 4, 8)
    samples: int = 200
    seed: int = DEFAULT_SEED
    """Of the noise of the triangulation baseline; the captures have their own."""
    batch_size: int = 8
    protocol: str = "poem"
    progress: bool = True

    def __post_init__(self) -> None:
        find_protocol(self.protocol)
        if not self.views or not all(1 <= n <= MAX_VIEWS for n in self.views):
            raise ValueError(f"`views` must name counts from 1 to {MAX_VIEWS}; got {self.views}")
        if len(set(self.views)) < len(self.views):
            raise ValueError(f"`views` must name each count once; got {self.views}")
        if self.samples < 1 or self.batch_size < 1:
            raise ValueError(
                f"`samples` and `batch_size` must be at least 1; got {self.samples}, {self.batch_size}"
            )


class Reconstructions(NamedTuple):
    """A batch reconstructed twice. Where one view does not fix the root, the second is both."""

    found: Prediction
    """The model as it is used: it finds the root itself, or needs none."""
    given: Prediction | None
    """With the true root given; None for a model that takes none."""


Predictor = Callable[[MultiViewBatch], Reconstructions]


class _Rows(NamedTuple):
    """What is kept of every sample, for one view count; leading axis sample, world frame, metres."""

    joints: np.ndarray
    vertices: np.ndarray
    root: np.ndarray
    """NaN for a model without a root."""
    vertices_given: np.ndarray
    """NaN for a model that takes no root."""
    vertices_fitted: np.ndarray
    """NaN where there is no fit to compare with."""
    fitted: np.ndarray
    """False where the fit says that it found no hand."""
    valid: np.ndarray
    dlt_root: np.ndarray


class _Truth(NamedTuple):
    joints: np.ndarray
    vertices: np.ndarray
    global_rotation: np.ndarray
    T_primary_from_world: np.ndarray


_Leaves = TypeVar("_Leaves", _Rows, _Truth)


def model_predictor(params: Params, config: ModelConfig) -> Predictor:
    """Return the predictor of a model; every shape of batch compiles once.

    A model that is made for a number of views gets masked ones beside those that there are. The predictor
    raises `ValueError` for numbers of views that the model cannot take.
    """
    both, given = (jax.jit(partial(f, config=config)) for f in (_reconstruct, _reconstruct_given))

    def predict(batch: MultiViewBatch) -> Reconstructions:
        root_true, num_views = batch.joints_world[:, ROOT_JOINT], batch.views.shape[1]
        if num_views == 1 and config.triangulates and not config.takes_root:
            raise ValueError(
                f"this {type(config).__name__} needs two views or more, for one view does not fix the root, "
                "and it takes none; leave 1 out of the view counts"
            )
        reconstruct = given if num_views == 1 and config.takes_root else both
        padded = pad_views(batch, max(num_views, config.view_range[0]))
        return reconstruct(params, padded.views, padded.cameras, root_true)

    return predict


def run_benchmark(
    predict: Predictor,
    captures: Captures,
    settings: BenchmarkSettings,
    hand: HandModel | None = None,
    fitting: System | None = None,
) -> dict[int, Scores]:
    """Score a model on captures 0, 1, ... for every view count.

    Args:
        predict: reconstructs a batch; see `model_predictor`.
        captures: samples with `pose`, at least as many views as `settings.views` asks for.
        settings: sizes and definitions.
        hand: whose regressor the protocol `poem-release` uses; the others need none.
        fitting: the fit to the key points of the model's own first stage, which it must beat; None = it has
            no such key points.

    Returns: per view count the metrics of `evaluate`, and `median_mpvpe_mm`, `mpvpe_true_root_mm` and its
    `median_`, `root_error_mm`, `dlt_2px_root_error_mm`, `mean_pose_mpvpe_mm`, `mean_pose_rotated_mpvpe_mm`,
    `fit_mpvpe_mm`, its `median_` and `fit_unsolved`, `samples` and `unsolved` (samples that fit or model
    itself calls invalid; they count in all errors). Errors of a root that the model does not have, with a
    true root that it does not take, or of a fit that there is not are None.

    Raises:
        ValueError: a prediction that is not finite.
    """
    rows: dict[int, list[_Rows]] = {n: [] for n in settings.views}
    truths: list[_Truth] = []
    num_batches = -(-settings.samples // settings.batch_size)
    noise_shape = (num_batches, settings.batch_size, max(settings.views), 2)
    noise = np.random.default_rng(settings.seed).standard_normal(noise_shape, dtype=np.float32)
    total = num_batches * len(settings.views)
    with tqdm(total=total, unit="batch", desc="evaluating", disable=not settings.progress) as bar:
        for batch, draws in zip(_batches(captures, settings), noise, strict=True):
            truths.append(_without_padding(batch, _truth(batch)))
            for n in settings.views:
                part = nested_views(batch, n)
                fitted = None if fitting is None or n < fitting.least_views else fitting(part, ())
                rows[n].append(_without_padding(batch, _row(part, predict(part), fitted, draws[:, :n])))
                bar.update()
    truth = _joined(truths)
    return {n: _scores(_joined(rows[n]), truth, settings.protocol, hand) for n in settings.views}


def nested_views(batch: MultiViewBatch, num_views: int) -> MultiViewBatch:
    """Keep the first views of every sample."""
    cameras = Cameras(*(leaf[:, :num_views] for leaf in batch.cameras))
    return batch._replace(
        views=batch.views[:, :num_views], keypoints_px=batch.keypoints_px[:, :num_views], cameras=cameras
    )


def _batches(captures: Captures, settings: BenchmarkSettings) -> Iterator[MultiViewBatch]:
    """Yield the captures in order; the last batch is padded, so that one program serves all."""
    max_views = max(settings.views)
    for start in range(0, settings.samples, settings.batch_size):
        indices = range(start, min(start + settings.batch_size, settings.samples))
        batch = collate([captures.sample(index, num_views=max_views) for index in indices], max_views)
        yield pad_batch(batch, settings.batch_size)


def _reconstruct(
    params: Params, views: Array, cams: Cameras, root_true: Array, *, config: ModelConfig
) -> Reconstructions:
    found = apply(params, views, cams, config=config)
    if not config.takes_root:
        return Reconstructions(found, None)
    return Reconstructions(found, apply(params, views, cams, config=config, root_world=root_true))


def _reconstruct_given(
    params: Params, views: Array, cams: Cameras, root_true: Array, *, config: ModelConfig
) -> Reconstructions:
    given = apply(params, views, cams, config=config, root_world=root_true)
    return Reconstructions(given, given)


def _truth(batch: MultiViewBatch) -> _Truth:
    if batch.pose is None:
        raise ValueError("samples of a benchmark must have `pose`; got None")
    primary = batch.cameras.T_cam_from_world[:, 0]
    return _Truth(*map(_float64, (batch.joints_world, batch.vertices_world, batch.pose[:, 0], primary)))


def _row(
    batch: MultiViewBatch, predicted: Reconstructions, fitted: Answer | None, noise: np.ndarray
) -> _Rows:
    found, given = predicted
    K, T_cam_from_world, _ = batch.cameras
    root_px = batch.keypoints_px[:, :, ROOT_JOINT]
    vertices = _float64(found.vertices_world)
    no_root = np.full((len(vertices), 3), np.nan)
    return _Rows(
        joints=_float64(found.joints_world),
        vertices=vertices,
        root=no_root if found.root_world is None else _float64(found.root_world),
        vertices_given=np.full_like(vertices, np.nan) if given is None else _float64(given.vertices_world),
        vertices_fitted=np.full_like(vertices, np.nan) if fitted is None else _float64(fitted.vertices_world),
        fitted=np.zeros(len(vertices), bool) if fitted is None else np.asarray(fitted.valid),
        valid=np.asarray(found.valid),
        dlt_root=noisy_dlt_roots(root_px, K, T_cam_from_world, noise),
    )


def _float64(array: Array) -> np.ndarray:
    return np.asarray(array, dtype=np.float64)


def _without_padding(batch: MultiViewBatch, leaves: _Leaves) -> _Leaves:
    """Drop the samples that only pad the batch."""
    return type(leaves)(*(leaf[batch.sample_mask] for leaf in leaves))


def _joined(parts: list[_Leaves]) -> _Leaves:
    return type(parts[0])(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))


def _scores(rows: _Rows, truth: _Truth, protocol: str, hand: HandModel | None) -> Scores:
    one_constant = mean_pose(truth.vertices, truth.joints, truth.T_primary_from_world)
    turned = mean_pose_rotated(truth.vertices, truth.joints, truth.global_rotation)
    root_true = truth.joints[:, ROOT_JOINT]
    found, given, fitted, constant, rotated = (
        MM_PER_METRE * point_distances(vertices, truth.vertices).mean(-1)
        for vertices in (rows.vertices, rows.vertices_given, rows.vertices_fitted, one_constant, turned)
    )
    official = evaluate(
        rows.joints, truth.joints, rows.vertices, truth.vertices, protocol=protocol, hand=hand
    )
    return official | {
        "median_mpvpe_mm": float(np.median(found)),
        "mpvpe_true_root_mm": _known(np.mean(given)),
        "median_mpvpe_true_root_mm": _known(np.median(given)),
        "root_error_mm": _mean_mm(rows.root, root_true),
        "dlt_2px_root_error_mm": _mean_mm(rows.dlt_root, root_true),
        "mean_pose_mpvpe_mm": float(constant.mean()),
        "mean_pose_rotated_mpvpe_mm": float(rotated.mean()),
        "fit_mpvpe_mm": _known(np.mean(fitted)),
        "median_fit_mpvpe_mm": _known(np.median(fitted)),
        "fit_unsolved": None if np.isnan(fitted).any() else int((~rows.fitted).sum()),
        "samples": len(found),
        "unsolved": int((~rows.valid).sum()),
    }


def _known(value: np.floating) -> float | None:
    """Return None for NaN, which stands where there was nothing."""
    return None if np.isnan(value) else float(value)


def _mean_mm(points: np.ndarray, truth: np.ndarray) -> float | None:
    """Mean distance over the samples that have a point; None where none has."""
    distances = np.linalg.norm(points - truth, axis=-1)
    there = np.isfinite(distances)
    return float(MM_PER_METRE * distances[there].mean()) if there.any() else None
