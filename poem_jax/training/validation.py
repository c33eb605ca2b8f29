"""Errors on held-out captures while training: a short look, not the evaluation."""

from functools import partial

import jax
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.models.apply import apply
from poem_jax.training.config import TrainConfig
from poem_jax.training.parallel import AXIS, put_batch
from poem_jax.training.source import validation_batches
from poem_jax.training.state import TrainState, evaluation_params
from poem_jax.typing import Array, Params


class Validation:
    """Evaluates the averaged weights on the same held-out samples every time."""

    def __init__(self, config: TrainConfig, mesh: Mesh) -> None:
        self.mesh = mesh
        self.batches = {n: validation_batches(config, n) for n in config.train.validation_views}
        specs = (P(), P(AXIS), P(AXIS), P(AXIS))
        predict = partial(_predict, config=config)
        self.predict = jax.jit(
            jax.shard_map(predict, mesh=mesh, in_specs=specs, out_specs=P(AXIS), check_vma=False)
        )

    def __call__(self, state: TrainState) -> dict[str, float]:
        """Return by view count the mean and median vertex error, the root's error where the model has one,
        and where it takes one the vertex error with the true root given; millimetres."""
        metrics: dict[str, float] = {}
        params = evaluation_params(state)
        for num_views, batches in self.batches.items():
            errors = [self._errors(params, batch) for batch in batches]
            for name in errors[0]:
                values = np.concatenate([error[name] for error in errors])
                metrics[f"{name}_{num_views}views"] = float(values.mean())
            vertices = np.concatenate([error["mpvpe_mm"] for error in errors])
            metrics[f"median_mpvpe_mm_{num_views}views"] = float(np.median(vertices))
        return metrics

    def _errors(self, params: Params, batch: MultiViewBatch) -> dict[str, Array]:
        root_true = batch.joints_world[:, ROOT_JOINT]
        placed = put_batch(batch._replace(root_world=root_true), self.mesh)
        found, given = self.predict(params, placed.views, placed.cameras, placed.root_world)
        errors = {"mpvpe_mm": _distance_mm(found.vertices_world, batch.vertices_world).mean(-1)}
        if found.root_world is not None:
            errors["root_mm"] = _distance_mm(found.root_world, root_true)
        if given is not None:
            errors["true_root_mpvpe_mm"] = _distance_mm(given.vertices_world, batch.vertices_world).mean(-1)
        return errors


def _predict(
    params: Params, views: Array, cameras: Array, root_world: Array, *, config: TrainConfig
) -> tuple[Prediction, Prediction | None]:
    """Reconstruct with the triangulated root and, where the model takes one, with the true one."""
    found = apply(params, views, cameras, config=config.model)
    if not config.model.takes_root:
        return found, None
    given = apply(params, views, cameras, config=config.model, root_world=root_world)
    return found, given


def _distance_mm(a: Array, b: Array) -> Array:
    return 1000.0 * np.linalg.norm(np.asarray(a) - b, axis=-1)
