"""Ties between neighbours, resolved as a stored float32 run resolved them.

Two runs of one function in float32 differ: block 0 by 1e-6 m, and from block 1 on a query may read another
32nd neighbour, where the 32nd and the 33rd are equally near. About one search in 2,400 does; that moves its
query by up to 5 mm, those that read it later by less, and all vertices of the parametric model by 0.1 mm. The
stored float32 runs differ in this way from the stored float64 runs, and our own programs from each other.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.hand.topology import NUM_QUERIES
from poem_jax.models.world_frame import enter_working_frame
from tests.weights.halves import find_hands, look_in_parts
from tests.weights.procedural import released

PARAMETRIC = "medium_MANO"
SHARE, FARTHEST_M = 0.995, 5e-3
"""The share of the points of a block that must be within `limit_m`, and the limit for the others."""
TIE, TIE_UNDER_MESH = 1e-5, 3e-6
"""Squared distances (in units of 10 cm) that two runs may order differently; the gap is typically 1e-3. The
second is for searches whose outcome cannot be seen one by one: there each tie is tried."""
MAX_SWAPS = 12
"""Searches of a case that may have to end otherwise; there are 3,196 per sample."""
SEARCHES = {1: slice(0, 2), 2: slice(2, 4)}
"""Every block from the second on searches among the basis points, then among the queries."""


class Run(NamedTuple):
    """A run, and how its searches (search, batch, query) ended."""

    prediction: Prediction
    gaps: np.ndarray
    """How much farther the 33rd neighbour is than the 32nd, squared, units of 10 cm."""
    index: np.ndarray
    """The neighbours (..., 32)."""
    swapped: np.ndarray
    """Those that took the 33rd in place of the 32nd."""


def limit_m(model: str, block: int) -> float:
    return 1e-4 if model == PARAMETRIC and block == 2 else 2e-5


class Halves:
    """A released model on a batch, run in two halves: the first once, the second for a choice of ties."""

    def __init__(self, model: str, batch: MultiViewBatch, root_world: np.ndarray | None) -> None:
        self.model = model
        self.config, self.params = released(model)
        self.seen = look_in_parts(self.params, batch.views, config=self.config)
        self.frame = enter_working_frame(batch.views, batch.cameras, root_world, np.float32)

    def __call__(self, swapped: np.ndarray) -> Run:
        prediction, gaps, heard = find_hands(self.params, self.seen, self.frame, swapped, config=self.config)
        found = jax.tree.map(np.asarray, (prediction, gaps, heard["neighbours"]))
        return Run(found[0], found[1], np.stack(found[2]), swapped)

    @functools.cached_property
    def unchanged(self) -> Run:
        """The run with all ties as they fall."""
        return self(np.zeros((4, len(self.frame.known_root), NUM_QUERIES), bool))


def resolve(halves: Halves, stored: np.ndarray) -> Run:
    """Swap the ties of the queries that are off, block by block.

    `stored`: the points (batch, block, 799, 3) of the run to compare with.
    """
    run = halves.unchanged
    for block, searches in SEARCHES.items():
        if halves.model == PARAMETRIC and block == 2:
            return _resolve_under_mesh(halves, run, stored)
        gaps, swapped = run.gaps[searches], run.swapped.copy()
        off = _distances(run, stored, block) > limit_m(halves.model, block)
        swapped[searches] = (gaps < TIE) & (gaps == gaps.min(0)) & off
        run = halves(swapped)
    return run


def _distances(run: Run, stored: np.ndarray, block: int) -> np.ndarray:
    return np.linalg.norm(run.prediction.layers_world[:, block] - stored[:, block], axis=-1)


def _resolve_under_mesh(halves: Halves, run: Run, stored: np.ndarray) -> Run:
    """Resolve the ties of the parametric model's last block.

    Its queries are not stored, only the mesh, which hangs on all of them: swap one tie of every sample at a
    time, the closest first, and keep what brings that sample's mesh nearer.
    """
    samples = np.arange(run.gaps.shape[1])
    gaps = np.swapaxes(run.gaps[SEARCHES[2]], 0, 1).reshape(len(samples), -1)
    kept, error = run.swapped, np.sum(_distances(run, stored, 2) ** 2, -1)
    for places in np.argsort(gaps, axis=1)[:, : np.max(np.sum(gaps < TIE_UNDER_MESH, 1))].T:
        if np.sqrt(error.max()) <= limit_m(halves.model, 2):
            break
        swapped = kept.copy()
        is_tie = gaps[samples, places] < TIE_UNDER_MESH
        swapped[SEARCHES[2]][places // NUM_QUERIES, samples, places % NUM_QUERIES] |= is_tie
        trial = np.sum(_distances(halves(swapped), stored, 2) ** 2, -1)
        kept = np.where((trial < error)[:, None], swapped, kept)
        error = np.minimum(trial, error)
    return halves(kept)


def assert_only_ties(run: Run) -> None:
    """Few searches were swapped, all of them between neighbours as good as equally near."""
    assert run.swapped.sum() <= MAX_SWAPS
    assert run.gaps[run.swapped].max(initial=0) < TIE
    assert np.median(run.gaps) > 20 * TIE


def assert_points_agree(distance_m: np.ndarray, limit: float) -> None:
    share = np.mean(distance_m <= limit)
    assert share >= SHARE, f"{share:.4f} of the points are within {limit} m"
    assert distance_m.max() <= FARTHEST_M
