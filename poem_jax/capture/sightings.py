"""Detections as rays: what a camera sees of hands, in metres and votes.

Every detection is 21 rays. The noise of a detector is a share of the hand's size, hence about the same in
metres in all views: distances between joints and rays are measured in metres, and views of any resolution
count alike.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.detection import DetectedHand
from poem_jax.geometry.cameras import normalised_from_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid, rotate_points
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.typing import Array, Bool, Float, Int

NONE = -1
"""In place of a detection's number: the view has none."""
SAME_HAND_M = 0.020
"""Rays of a second detection of one hand pass its joints within this; those of two hands that touch do not,
in some view at least."""
MAX_VOTE = 2.0
"""Log odds of a side that one detection can give: even a sure detector is wrong one time in eight."""

_TRUSTED_SHARE = 2 / 3
"""Of a hand's joints, the nearest: tips and hidden joints are often wrong."""
_MIN_JOINTS = 10
_TOGETHER = 64
"""Frames whose rays are computed at once."""
_KEPT = 4
"""Such groups that are kept: whoever goes through the frames, or back, has each computed once."""


class Sightings(NamedTuple):
    """The detections of one frame, all views in a row."""

    view: Int[Array, " found"]
    number: Int[Array, " found"]
    """Place among the detections of its view."""
    centres_world: Float[Array, "found 3"]
    """Of the cameras, metres."""
    rays_world: Float[Array, "found 21 3"]
    """Unit directions; NaN where no ray reaches the pixel."""
    across_world: Float[Array, "found 21 3 3"]
    """I - d d^T, which keeps what is across a ray; zero where there is none."""
    pulls_world: Float[Array, "found 21 3"]
    """(I - d d^T) c, with the centre c of the camera."""
    votes: Float[Array, " found"]
    """Log odds that it is a right hand."""
    num_views: int


class SightingsOfFrames(Sequence[Sightings]):
    """The rays and votes of the detections of every frame, computed when they are asked for.

    A detection's rays take 15 times the memory of its key points.
    """

    def __init__(self, detections: Sequence[Sequence[Sequence[DetectedHand]]], rig: Rig) -> None:
        """`detections`: by frame, view and hand found."""
        self._length = len(detections)

        @lru_cache(_KEPT)
        def group(number: int) -> list[Sightings]:
            rows = range(number * _TOGETHER, min((number + 1) * _TOGETHER, self._length))
            return _sightings_of_group([detections[row] for row in rows], rig)

        self._group = group

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, frame: int) -> Sightings:
        if not 0 <= frame < self._length:
            raise IndexError(frame)
        return self._group(frame // _TOGETHER)[frame % _TOGETHER]


def _sightings_of_group(detections: Sequence[Sequence[Sequence[DetectedHand]]], rig: Rig) -> list[Sightings]:
    places = [
        (frame, view, number)
        for frame, views in enumerate(detections)
        for view, found in enumerate(views)
        for number in range(len(found))
    ]
    table = np.array(places, dtype=int).reshape(-1, 3)
    hands = [detections[frame][view][number] for frame, view, number in places]
    rays = np.full((len(hands), NUM_JOINTS, 3), np.nan)
    for view in range(rig.num_views):
        here = np.flatnonzero(table[:, 1] == view)
        if here.size:
            rays[here] = _rays(rig.select([rig.names[view]]), np.stack([hands[i].keypoints_px for i in here]))
    centres = invert_rigid(rig.T_cam_from_world)[:, :3, 3][table[:, 1]]
    across = np.nan_to_num(np.eye(3) - rays[..., :, None] * rays[..., None, :])
    votes = np.array([vote_for_right(hand) for hand in hands])
    pulls = np.einsum("njab,nb->nja", across, centres)
    every = Sightings(table[:, 1], table[:, 2], centres, rays, across, pulls, votes, rig.num_views)
    return [
        Sightings(*(column[table[:, 0] == frame] for column in every[:-1]), num_views=rig.num_views)
        for frame in range(len(detections))
    ]


def _rays(camera: Rig, keypoints_px: Float[Array, "hand 21 2"]) -> Float[Array, "hand 21 3"]:
    ideal_px = ideal_keypoints(camera, keypoints_px[:, None, None].astype(float))[:, 0, 0]
    xy = normalised_from_pixels(camera.K, ideal_px)
    rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
    rays = rotate_points(invert_rigid(camera.T_cam_from_world)[..., :3, :3], rays)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def vote_for_right(hand: DetectedHand) -> float:
    """Return the log odds that a detection is a right hand, at most `MAX_VOTE`."""
    score = np.clip(hand.side_score, 0.5, 1 - 1e-6)
    odds = min(float(np.log(score / (1 - score))), MAX_VOTE)
    return odds if hand.side == "right" else -odds


def ray_distances(
    sightings: Sightings, joints_world: Float[Array, "*batch 21 3"]
) -> Float[Array, "*batch found"]:
    """Return how far the rays of every detection pass hands: root mean square over the nearest joints.

    Returns: metres; infinite for hands behind the camera.
    """
    offset, ahead = _offsets(sightings, joints_world)
    return np.where(ahead, np.sqrt(trimmed_mean((offset**2).sum(-1))), np.inf)


def shifted_distances(
    sightings: Sightings, joints_world: Float[Array, "21 3"]
) -> tuple[Float[Array, "found 3"], Float[Array, " found"]]:
    """Return the move of a hand across each detection's rays that brings it closest, and the distance left.

    Returns: metres, world frame; see `ray_distances` for the distance.
    """
    offset, ahead = _offsets(sightings, joints_world)
    move = -np.median(np.where(np.isfinite(offset), offset, 0), axis=-2)
    left = trimmed_mean(((offset + move[:, None]) ** 2).sum(-1))
    return move, np.where(ahead, np.sqrt(left), np.inf)


def _offsets(
    sightings: Sightings, joints_world: Float[Array, "*batch 21 3"]
) -> tuple[Float[Array, "*batch found 21 3"], Bool[Array, "*batch found"]]:
    """Return the shortest way from each ray to its joint, and whether the hand is ahead of the camera."""
    between = joints_world[..., None, :, :] - sightings.centres_world[:, None]
    along = (between * sightings.rays_world).sum(-1, keepdims=True)
    ahead = (np.where(np.isfinite(along), along, 1) > 0).all((-2, -1))
    return between - along * sightings.rays_world, ahead


def trimmed_mean(values: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the mean of the smaller part of the values; infinite where too few are finite."""
    count = np.isfinite(values).sum(-1)
    kept = np.ceil(_TRUSTED_SHARE * count).astype(int)
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf), axis=-1)
    used = np.arange(values.shape[-1]) < kept[..., None]
    mean = np.where(used, ordered, 0).sum(-1) / np.maximum(kept, 1)
    return np.where(count >= _MIN_JOINTS, mean, np.inf)
