"""How far a network's hand is to be trusted, from what the network itself lets see.

Two signs of doubt are told in metres, joint by joint: how far its decoder still moved the joint from layer
to layer, and how narrowly its heat maps fix the joint where the views' rays cross. What they are worth is
measured on synthetic captures (`tools/measure_trust.py`): they are combined to a standard deviation within
which 68 % of the errors of a coordinate lie. A view's confidence in a joint is its heat map's sharpness,
times how well the joint lies where the heat map has it.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.batch import Prediction
from poem_jax.capture.frame import HandCrops
from poem_jax.fitting.robust_weight import agreement
from poem_jax.geometry.cameras import project
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT, QueryOrder, split_queries
from poem_jax.typing import Array, Float

_MIN_SPREAD_CELLS = 0.3
"""Nobody knows a place better than this from cells of a map."""


class TrustScale(NamedTuple):
    """What the signs of doubt of a model are worth."""

    of_layers: float
    """Factor of the movement between the layers."""
    of_rays: float
    """Factor of the width of the place that the heat maps leave open."""
    sharp_share: float
    """Spread of the heat map of a joint in plain view, as a share of the crop's side."""
    off_share: float
    """Distance along an axis of the heat map's point from the true one, for such a joint, as such a share."""
    calibrated: bool
    """Whether all this was measured with the model that it is used for."""


SHIPPED = TrustScale(1.82, 0.56, 0.0444, 0.0263, calibrated=True)
"""Of the shipped weights, by `tools/measure_trust.py --samples 60`: captures of seed 5150 seen by 2, 3, 4 and
8 views. Of the benchmark's captures (another seed) 61, 70, 72 and 73 % of the errors lie within one of it."""
GENERAL = SHIPPED._replace(calibrated=False)
"""For other weights: the shipped ones' factors, for want of better."""


class Doubts(NamedTuple):
    """Signs of doubt about one hand; NaN = masked view."""

    layers_m: Float[Array, "21"] | None
    """How far the joint stood from its final place after the layers before: root mean square, along an
    axis; None for a model of one layer."""
    rays_m: Float[Array, "21"] | None
    """Standard deviation of a coordinate from the spread of the heat maps, and from how far the joint lies
    beside them; None for a model without heat maps, and so are the next two."""
    spread_share: Float[Array, "view 21"] | None
    """Standard deviation of the heat map along an axis, as a share of the crop's side. A model with a heat
    map of the root alone has the root's for all joints."""
    off_share: Float[Array, "view 21"] | None
    """Distance of the joint from the heat map's point, as a share of the crop's side."""


def doubts_of(found: Prediction, fed: HandCrops, order: QueryOrder) -> Doubts:
    """Read the signs of doubt from one prediction (no batch axis), for the crops that were fed.

    Args:
        found: In the world of `fed`.
        fed: As the model saw them.
        order: Of the model's query points.
    """
    _, layers = split_queries(np.asarray(found.layers_world, np.float64), order)
    joints_world = np.asarray(found.joints_world, np.float64)
    moved = ((layers[:-1] - joints_world) ** 2).mean(-1)
    layers_m = np.sqrt(moved.mean(0)) if len(moved) else None
    if found.heat_maps is None or found.keypoints_px is None:
        return Doubts(layers_m, None, None, None)
    side_px = max(fed.views.shape[1:3])
    spread_px = _spread_cells(np.asarray(found.heat_maps, np.float64)) * side_px / found.heat_maps.shape[-1]
    own = slice(None) if found.keypoints_px.shape[-2] == NUM_JOINTS else [ROOT_JOINT]
    projected, depth_m = project(
        fed.K.astype(np.float64), fed.T_cam_from_world.astype(np.float64), joints_world
    )
    off_px = np.linalg.norm(projected[:, own] - found.keypoints_px, axis=-1)
    unseen = ~fed.view_mask[:, None]
    spread_px, off_px = (
        np.where(unseen, np.nan, np.broadcast_to(x, projected.shape[:-1])) for x in (spread_px, off_px)
    )
    focal_px = fed.K[:, 0, 0].astype(np.float64)[:, None]
    metres_per_px = np.where(unseen, 1.0, np.abs(depth_m) / focal_px)
    width_m = metres_per_px * np.sqrt(spread_px**2 + off_px**2 / 2)
    rays_m = 1 / np.sqrt(np.nansum(width_m**-2, axis=0))
    return Doubts(layers_m, rays_m, spread_px / side_px, off_px / side_px)


def joint_sigma(doubts: Doubts, scale: TrustScale) -> Float[Array, "21"] | None:
    """Return the standard deviation of one coordinate of each joint, metres; None where nothing tells it."""
    parts = [
        factor * sign_m
        for factor, sign_m in ((scale.of_layers, doubts.layers_m), (scale.of_rays, doubts.rays_m))
        if sign_m is not None
    ]
    return np.sqrt(np.sum(np.square(parts), axis=0)) if parts else None


def joint_confidence(doubts: Doubts, scale: TrustScale) -> Float[Array, "view 21"] | None:
    """Return how far each view bears each joint out, 0 to 1; NaN = masked view; None without heat maps."""
    if doubts.spread_share is None or doubts.off_share is None:
        return None
    sharpness = np.minimum(1.0, (scale.sharp_share / doubts.spread_share) ** 2)
    return sharpness * agreement(doubts.off_share, scale.off_share)


def _spread_cells(heat_maps: Float[Array, "view joint h w"]) -> Float[Array, "view joint"]:
    """Return the standard deviation of maps along an axis, in cells of their width."""
    variance = np.zeros(heat_maps.shape[:2])
    for profile in (heat_maps.sum(-1), heat_maps.sum(-2)):
        cells = np.arange(profile.shape[-1])
        total = np.maximum(profile.sum(-1), 1e-12)
        mean = (profile * cells).sum(-1) / total
        variance += (profile * (cells - mean[..., None]) ** 2).sum(-1) / total / 2
    return np.sqrt(np.maximum(variance, _MIN_SPREAD_CELLS**2))
