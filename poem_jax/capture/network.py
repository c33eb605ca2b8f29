"""The stage `predict` by a network: crops of hands in, hands in the capture's world out.

The models know right hands. A left hand is reconstructed in the world mirrored by D = diag(-1, 1, 1):
extrinsics D T D, images flipped, principal points W - cx; what comes back is mirrored again. Both happen
here, around the prediction, and nowhere else.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import jax
import numpy as np

from poem_jax.batch import Prediction
from poem_jax.capture.frame import Frame, HandCrops, HandResult, too_few_views
from poem_jax.capture.network_trust import (
    GENERAL,
    SHIPPED,
    TrustScale,
    doubts_of,
    joint_confidence,
    joint_sigma,
)
from poem_jax.capture.take import Take, in_groups
from poem_jax.geometry.cameras import (
    Cameras,
    mirror_intrinsics,
    mirror_pixels,
    mirror_points,
    mirror_world,
    normalised_from_pixels,
    pixels_from_normalised,
)
from poem_jax.geometry.distortion import distort
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import transform_points
from poem_jax.hand.model import HandModel, mirror_pose
from poem_jax.hand.pair import Hands, hands_of
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.models.config import ModelConfig
from poem_jax.models.infer import Prepared, infer_unchecked, prepare
from poem_jax.typing import Array, Int, Params
from poem_jax.weights import store

MAX_BATCH = 4
"""Hands at a time: enough to keep two cores busy, little enough to wait for."""
UNDETERMINED = (
    "the views do not determine where the hand is: they stand at one place, or their rays do not cross"
)


class Network(NamedTuple):
    """A model in memory, ready to predict."""

    config: ModelConfig
    prepared: Prepared
    origin: str = "given"
    """Where the weights came from, for the report."""
    predict: Callable[[Prepared, Array, Cameras], Prediction] = infer_unchecked
    trust: TrustScale = GENERAL
    """What the model's signs of doubt are worth."""

    def faces(self) -> dict[str, Int[Array, "face 3"]]:
        """Return the triangles of the model's hand, and those of its mirror image, facing outwards."""
        right = np.asarray(self.prepared.params["constants"]["hand"]["faces"])
        return {"right": right, "left": np.ascontiguousarray(right[:, ::-1])}

    def hands(self) -> Hands | None:
        """Return the model's hand, of which it may give pose, shape and place, and its mirror image; None
        where it has triangles alone."""
        fields = self.prepared.params["constants"]["hand"]
        if not set(HandModel._fields) <= set(fields):
            return None
        return hands_of(HandModel(**{name: fields[name] for name in HandModel._fields}))


def load_network(checkpoint: str | os.PathLike | None) -> Network:
    """Load a checkpoint folder, or the shipped weights for None.

    Raises: FileNotFoundError, ValueError: As `poem_jax.load`.
    """
    config, params = store.shipped() if checkpoint is None else store.load(checkpoint)
    if checkpoint is None:
        return make_network(config, params, "shipped weights", SHIPPED)
    return make_network(config, params, str(checkpoint))


def make_network(
    config: ModelConfig, params: Params, origin: str = "given", trust: TrustScale = GENERAL
) -> Network:
    """Prepare a model in memory.

    Raises: ValueError: The parameters are of another config.
    """
    return Network(config, prepare(params, config), origin, trust=trust)


def predict_hands(frames: Iterable[Frame], take: Take, network: Network) -> Iterator[Frame]:
    """Reconstruct the hands of a stream from their crops, some frames at a time.

    The batch is padded with masked hands, so that one program serves takes of any length. Where the samples
    of a batch depend on each other, every hand is a batch of its own: it is the same whatever is beside it.
    """
    check_rig(network.config, take.rig)
    num_hands = len(take.hand_sides)
    frames_together = max(1, MAX_BATCH // num_hands)
    batch_size = 1 if network.config.couples_samples else frames_together * num_hands
    for group in in_groups(frames, frames_together):
        crops = [_if_enough(crop, network.config) for frame in group for crop in frame.crops]
        sides = take.hand_sides * len(group)
        fed = [
            _mirrored(crop) if crop and side == "left" else crop
            for crop, side in zip(crops, sides, strict=True)
        ]
        predicted = chain.from_iterable(
            _predict(network, fed[i : i + batch_size], take.rig.num_views, batch_size)
            for i in range(0, len(fed), batch_size)
        )
        given = iter(fed)
        for frame in group:
            results = (
                _result(network, crop, next(given), next(predicted), known, side, take.rig)
                for crop, known, side in zip(frame.crops, frame.hands, take.hand_sides, strict=True)
            )
            yield frame._replace(hands=tuple(results), crops=())


def check_rig(config: ModelConfig, rig: Rig) -> None:
    """Raise `ValueError` for a number of cameras that a model cannot take."""
    least, most = config.view_range
    if rig.num_views < least or (most is not None and rig.num_views > most):
        raise ValueError(
            f"the rig must have {config.views_in_words} cameras, as the layers of this "
            f"{type(config).__name__} are made for; got {rig.num_views}. Take a model for {rig.num_views}, "
            "or the shipped weights, which take any number"
        )


def views_needed(config: ModelConfig) -> int:
    """Return how many views must see a hand before a model can place it."""
    return 2 if config.triangulates else 1


def _if_enough(crops: HandCrops | None, config: ModelConfig) -> HandCrops | None:
    return None if crops is None or crops.view_mask.sum() < views_needed(config) else crops


def _mirrored(crops: HandCrops) -> HandCrops:
    """Return the capture of the mirrored hand in the mirrored world; its own inverse."""
    return HandCrops(
        np.ascontiguousarray(crops.views[:, :, ::-1]),
        mirror_intrinsics(crops.K, crops.views.shape[2]),
        mirror_world(crops.T_cam_from_world),
        crops.view_mask,
    )


def _predict(
    network: Network, hands: Sequence[HandCrops | None], num_views: int, batch_size: int
) -> list[Prediction | None]:
    """Run a batch, in which None and what is missing is masked; return one prediction per hand."""
    height, width = network.config.image_hw
    masked = HandCrops(
        np.zeros((num_views, height, width, 3), np.uint8),
        np.tile(np.eye(3, dtype=np.float32), (num_views, 1, 1)),
        np.tile(np.eye(4, dtype=np.float32), (num_views, 1, 1)),
        np.zeros(num_views, bool),
    )
    padded = [hand or masked for hand in hands] + [masked] * (batch_size - len(hands))
    views, K, T_cam_from_world, view_mask = (np.stack(part) for part in zip(*padded, strict=True))
    cams = Cameras(K, T_cam_from_world, view_mask)
    if not view_mask.any():
        return [None] * len(hands)
    batch = jax.device_get(network.predict(network.prepared, views, cams))
    return [jax.tree.map(lambda field, i=i: field[i], batch) for i in range(len(hands))]


def _result(
    network: Network,
    crops: HandCrops | None,
    fed: HandCrops | None,
    predicted: Prediction | None,
    known: HandResult,
    side: str,
    rig: Rig,
) -> HandResult:
    """Bring a prediction for the crops `fed` back to the capture's world, or say why there is none."""
    if crops is None:
        return known
    views, needed = int(crops.view_mask.sum()), views_needed(network.config)
    if views < needed:
        return HandResult(crops.view_mask, too_few_views(views, needed))
    if predicted is None or not predicted.valid:
        return HandResult(crops.view_mask, UNDETERMINED)
    assert fed is not None
    doubts = doubts_of(predicted, fed, network.config.query_order)
    if side == "left":
        predicted = _mirrored_back(predicted, crops.views.shape[2])
    # A model without a root of its own still says where the root joint is.
    root_world = predicted.joints_world[ROOT_JOINT] if predicted.root_world is None else predicted.root_world
    behind = _behind(root_world, crops, rig)
    if behind:
        return HandResult(crops.view_mask, f"the hand would lie behind camera {', '.join(behind)}")
    return HandResult(
        crops.view_mask,
        vertices_world=predicted.vertices_world,
        joints_world=predicted.joints_world,
        root_world=root_world,
        pose=predicted.pose,
        shape=predicted.shape,
        translation=predicted.translation,
        keypoints_px=_where_given(lambda px: _in_photographs(px, crops, rig), predicted.keypoints_px),
        joint_confidence=joint_confidence(doubts, network.trust),
        joint_sigma_m=joint_sigma(doubts, network.trust),
    )


def _mirrored_back(predicted: Prediction, crop_width: int) -> Prediction:
    """Bring a prediction for `_mirrored` crops back to the world that they were mirrored from."""
    return predicted._replace(
        vertices_world=mirror_points(predicted.vertices_world),
        joints_world=mirror_points(predicted.joints_world),
        root_world=_where_given(mirror_points, predicted.root_world),
        keypoints_px=_where_given(lambda px: mirror_pixels(px, crop_width), predicted.keypoints_px),
        pose=_where_given(mirror_pose, predicted.pose),
        translation=_where_given(mirror_points, predicted.translation),
    )


def _where_given(change: Callable[[Array], Array], value: Array | None) -> Array | None:
    """Change what the model gives; leave None for what it does not have."""
    return None if value is None else change(value)


def _behind(root_world: Array, crops: HandCrops, rig: Rig) -> list[str]:
    """Name the cameras that cannot have seen the root."""
    root = np.asarray(root_world, np.float64)
    depth = transform_points(rig.T_cam_from_world, root[None, None])[:, 0, 2]
    return [repr(rig.names[view]) for view in np.flatnonzero(crops.view_mask & (depth <= 0))]


def _in_photographs(keypoints_px: Array, crops: HandCrops, rig: Rig) -> Array:
    """Move pixels of the crops to the raw photographs; views that were not used hold NaN."""
    rays = normalised_from_pixels(crops.K.astype(np.float64), keypoints_px.astype(np.float64))
    raw = pixels_from_normalised(rig.K, distort(rays, rig.dist))
    return np.where(crops.view_mask[:, None, None], raw, np.nan)
