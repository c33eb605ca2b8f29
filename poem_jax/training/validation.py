"""Errors and pictures of held-out samples while training: a short look, not the evaluation."""

from collections.abc import Mapping
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.mixture.samples import Mixture
from poem_jax.models.apply import apply
from poem_jax.training.config import TrainConfig
from poem_jax.training.held_out import held_out_batches
from poem_jax.training.panel import draw_panel
from poem_jax.training.parallel import AXIS, put_batch
from poem_jax.training.source import validation_batches
from poem_jax.training.state import TrainState, evaluation_params
from poem_jax.typing import Array, Params, UInt8

PANEL_ROWS = 4
"""Samples of a picture."""
UNSOLVED_MM = 200.0
"""What a sample that is not solved counts in the comparison of checkpoints: about the length of a hand."""


class Validation:
    """Evaluates the averaged weights on the same held-out samples every time.

    These are synthetic captures of several numbers of views, and the frames that parts of the mixture hold
    out (`Part.held_out`), all views of each.
    """

    def __init__(self, config: TrainConfig, mesh: Mesh, mixture: Mixture | None = None) -> None:
        """Read the held-out frames of the mixture; synthetic captures are drawn when they are first needed.

        Args:
            config: the experiment.
            mesh: devices over which batches are split, of all hosts.
            mixture: the run's data where they are open already; None = opened here, if frames are held out.

        Raises:
            ValueError: none of a part's held-out frames can be used. Said here, before the first step: at the
                first validation it would cost the steps before it, and again at every restart.
        """
        self._config, self._mesh = config, mesh
        self._by_part = held_out_batches(config, mixture, multiple_of=mesh.size)
        specs = (P(), P(AXIS))
        self._errors = jax.jit(
            jax.shard_map(
                partial(_errors, config=config), mesh=mesh, in_specs=specs, out_specs=P(), check_vma=False
            )
        )
        self._find = jax.jit(partial(apply, config=config.model))

    def __call__(self, state: TrainState) -> dict[str, float]:
        """Return errors by view count (`mpvpe_mm_4views`) and by part (`mpvpe_mm_captures_desk`), in
        millimetres.

        For each: the mean and median vertex error, the root's error where the model has one, and where it
        takes one the vertex error with the true root given, of the samples that are solved
        (`Prediction.valid`); and `unsolved_share`, that of the others, whose errors mean nothing. Where none
        is solved, there is the share alone. Where there are several hosts, all must call.
        """
        metrics: dict[str, float] = {}
        params = evaluation_params(state)
        for group, batches in (self._by_views | self._by_part).items():
            found = [self._errors_of(params, batch) for batch in batches]
            errors = {name: np.concatenate([one[name] for one in found]) for name in found[0]}
            solved = errors.pop("solved")
            metrics[f"unsolved_share_{group}"] = float(1 - solved.mean())
            if not solved.any():
                continue
            metrics |= {f"{name}_{group}": float(values[solved].mean()) for name, values in errors.items()}
            metrics[f"median_mpvpe_mm_{group}"] = float(np.median(errors["mpvpe_mm"][solved]))
        return metrics

    def score(self, metrics: Mapping[str, float]) -> float:
        """Return the one number by which checkpoints are compared: the mean vertex error of the parts that
        hold frames out, or where none does, of the numbers of views; millimetres.

        A sample that is not solved counts as `UNSOLVED_MM`, so that nothing is gained by solving fewer.
        """
        return float(np.mean([_with_unsolved(metrics, group) for group in self._by_part or self._by_views]))

    def panel(self, state: TrainState) -> UInt8[np.ndarray, "h w 3"]:
        """Draw what the averaged weights find in a few held-out samples, a row each, over all their views.

        This host alone computes it, on one device.
        """
        batch = self._panel_batch
        params = jax.tree.map(_on_this_host, evaluation_params(state))
        found: Prediction = jax.device_get(self._find(params, batch.views, batch.cameras))
        faces = np.asarray(params["constants"]["hand"]["faces"])
        return draw_panel(batch, np.asarray(found.vertices_world), np.asarray(found.valid), faces)

    @cached_property
    def _by_views(self) -> dict[str, list[MultiViewBatch]]:
        counts = self._config.train.validation_views
        return {f"{n}views": validation_batches(self._config, n) for n in counts}

    @cached_property
    def _panel_batch(self) -> MultiViewBatch:
        """Take the first samples of every part that holds some out, or of the most views."""
        groups = list(self._by_part.values()) or [self._by_views[max(self._by_views, key=_number)]]
        each = -(-PANEL_ROWS // len(groups))
        rows = [_rows(batches[0], slice(0, each)) for batches in groups]
        return _rows(jax.tree.map(lambda *leaves: np.concatenate(leaves), *rows), slice(0, PANEL_ROWS))

    def _errors_of(self, params: Params, batch: MultiViewBatch) -> dict[str, Array]:
        """Return the errors of the real samples of a batch."""
        size, hosts = len(batch.views), jax.process_count()
        first = jax.process_index() * size // hosts
        own = _rows(batch, slice(first, first + size // hosts))
        root_world = np.asarray(own.joints_world[:, ROOT_JOINT])
        placed = put_batch(own._replace(root_world=root_world), self._mesh)
        real = slice(None) if batch.sample_mask is None else batch.sample_mask
        return {name: np.asarray(values)[real] for name, values in self._errors(params, placed).items()}


def _errors(params: Params, batch: MultiViewBatch, *, config: TrainConfig) -> dict[str, Array]:
    """Reconstruct a device's part with the triangulated root and, where the model takes one, with the true
    one; return the errors of all samples, and which are `solved`, on all devices."""
    views, cameras = batch.views, Cameras(*batch.cameras)
    found = apply(params, views, cameras, config=config.model)
    errors = {
        "solved": found.valid,
        "mpvpe_mm": _distance_mm(found.vertices_world, batch.vertices_world).mean(-1),
    }
    if found.root_world is not None:
        errors["root_mm"] = _distance_mm(found.root_world, batch.joints_world[:, ROOT_JOINT])
    if config.model.takes_root:
        given = apply(params, views, cameras, config=config.model, root_world=batch.root_world)
        errors["true_root_mpvpe_mm"] = _distance_mm(given.vertices_world, batch.vertices_world).mean(-1)
    return jax.lax.all_gather(errors, AXIS, tiled=True)


def _with_unsolved(metrics: Mapping[str, float], group: str) -> float:
    """Return a group's mean vertex error over all its samples, those that are not solved too."""
    unsolved = metrics[f"unsolved_share_{group}"]
    return (1 - unsolved) * metrics.get(f"mpvpe_mm_{group}", 0.0) + unsolved * UNSOLVED_MM


def _distance_mm(a: Array, b: Array) -> Array:
    return 1000.0 * jnp.linalg.norm(a - b, axis=-1)


def _rows(batch: MultiViewBatch, rows: slice) -> MultiViewBatch:
    return jax.tree.map(lambda leaf: leaf[rows], batch)


def _number(group: str) -> int:
    return int(group.removesuffix("views"))


def _on_this_host(leaf: Array) -> Array:
    """Return this host's copy of what every device holds whole."""
    return leaf.addressable_data(0) if isinstance(leaf, jax.Array) else leaf
