"""Score systems on captures that were drawn, sample by sample: their first views, or all in another order."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.batching import collate, pad_batch
from poem_jax.evaluation.baselines import mean_pose, mean_pose_rotated
from poem_jax.evaluation.benchmark import nested_views
from poem_jax.evaluation.dataset import Change
from poem_jax.evaluation.metrics import evaluate
from poem_jax.evaluation.systems import System
from poem_jax.typing import Float

PROTOCOL = "poem"
"""Joints are those that a system predicts."""


class Hands(NamedTuple):
    """A hand for every capture, in their world, metres."""

    joints: Float[np.ndarray, "sample 21 3"]
    vertices: Float[np.ndarray, "sample 778 3"]


class CaptureScores(NamedTuple):
    """Every metric of every capture."""

    rows: dict[str, Float[np.ndarray, " sample"]]
    """By metric, as `evaluate` names them."""
    unsolved: int = 0
    """Captures in which the system says that it found no hand; what it gave counts in all the same, so that
    every system is scored on the same captures."""


def batches_of(
    captures: Sequence[MultiViewBatch],
    num_views: int,
    *,
    batch_size: int,
    change: Change | None = None,
    seed: int = 0,
) -> Iterator[MultiViewBatch]:
    """Yield batches of one shape; `sample_mask` tells the captures from what fills up the last one.

    Args:
        captures: samples without batch axis, of `num_views` or more views.
        num_views: the first so many of each.
        batch_size: samples in a batch.
        change: what is done to the cameras; a sample's depends on the batch size, and on nothing else of a
            system, so that all systems get the same.
        seed: of `change`.
    """
    for number, start in enumerate(range(0, len(captures), batch_size)):
        samples = captures[start : start + batch_size]
        batch = collate(samples, max(len(one.views) for one in samples))
        batch = nested_views(pad_batch(batch, batch_size), num_views)
        if change is not None:
            batch = change(batch, key=jax.random.fold_in(jax.random.key(seed), number))
        yield jax.tree.map(np.asarray, batch)


def score_captures(
    system: System,
    captures: Sequence[MultiViewBatch],
    num_views: int,
    *,
    batch_size: int = 8,
    change: Change | None = None,
    seed: int = 0,
) -> CaptureScores:
    """Score a system on the first views of captures; arguments as of `batches_of`.

    Raises:
        ValueError: a prediction is not finite, or the system looks at one sample at a time.
    """
    if system.one_at_a_time:
        raise ValueError("a system whose samples depend on each other cannot be scored in batches")
    found: list[Hands] = []
    unsolved = 0
    for batch in batches_of(captures, num_views, batch_size=batch_size, change=change, seed=seed):
        assert batch.sample_mask is not None
        answer = system(batch, ())
        found.append(Hands(answer.joints_world[batch.sample_mask], answer.vertices_world[batch.sample_mask]))
        unsolved += int((~answer.valid[batch.sample_mask]).sum())
    hands = Hands(*(np.concatenate(leaves) for leaves in zip(*found, strict=True)))
    return CaptureScores(score_hands(hands, truth_of(captures)), unsolved)


def truth_of(captures: Sequence[MultiViewBatch]) -> Hands:
    """Return the hands that captures show."""
    joints, vertices = (
        np.stack([getattr(one, name) for one in captures]).astype(np.float64)
        for name in ("joints_world", "vertices_world")
    )
    return Hands(joints, vertices)


def score_hands(found: Hands, truth: Hands) -> dict[str, Float[np.ndarray, " sample"]]:
    """Return the metrics of `PROTOCOL`, each hand by itself.

    Raises:
        ValueError: a number is not finite.
    """
    rows = [
        evaluate(
            found.joints[i : i + 1],
            truth.joints[i : i + 1],
            found.vertices[i : i + 1],
            truth.vertices[i : i + 1],
            protocol=PROTOCOL,
        )
        for i in range(len(truth.joints))
    ]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def primary_cameras(
    captures: Sequence[MultiViewBatch],
    num_views: int,
    *,
    batch_size: int,
    change: Change | None = None,
    seed: int = 0,
) -> Float[np.ndarray, "sample 4 4"]:
    """Return T_cam_from_world of the camera in whose frame a system works; arguments as of `batches_of`."""
    without_images = [one._replace(views=one.views[:, :1, :1]) for one in captures]
    batches = batches_of(without_images, num_views, batch_size=batch_size, change=change, seed=seed)
    return np.concatenate([one.cameras.T_cam_from_world[one.sample_mask, 0] for one in batches])


def mean_hands(
    captures: Sequence[MultiViewBatch], T_primary_from_world: Float[np.ndarray, "sample 4 4"]
) -> Hands:
    """Return the mean of the very hands that are tested, at the true root; see `baselines.mean_pose`."""
    truth, T = truth_of(captures), T_primary_from_world.astype(np.float64)
    return Hands(*(mean_pose(points, truth.joints, T) for points in truth))


def mean_hands_rotated(captures: Sequence[MultiViewBatch]) -> Hands:
    """Return the same with the true global rotation; see `baselines.mean_pose_rotated`.

    Raises:
        ValueError: captures without `pose`.
    """
    poses = [one.pose for one in captures if one.pose is not None]
    if len(poses) < len(captures):
        raise ValueError(f"captures must have `pose`; got None in {len(captures) - len(poses)} of them")
    truth, rotation = truth_of(captures), np.stack([pose[0] for pose in poses]).astype(np.float64)
    return Hands(*(mean_pose_rotated(points, truth.joints, rotation) for points in truth))
