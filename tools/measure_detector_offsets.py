"""Measure where our detector puts the key points of rendered hands, in the frames of their bones.

    python tools/measure_detector_offsets.py [--hands 150] [--views 4] [--seed 0]

Each hand of the synthetic engine (its own shape, pose, skin and light, nothing in the way) is drawn from
several sides with the fingers up, as far as the hand allows. An offset is one vector for each key point,
fixed to its bone (`poem_jax.fitting.detector_offsets`); through a camera it moves the key point by a linear
map, so that the offsets come from all views at once by robust least squares, one key point at a time. Prints
a row for each key point: millimetres along, dorsal and thumbwards, with their standard errors over hands,
the spread (median distance in a view, at the depth of the hand) before and after, and the number of views.
"""

import argparse
from typing import NamedTuple

import numpy as np

from poem_jax.detection import DetectedHand, find_hands
from poem_jax.fitting.detector_offsets import AXIS_NAMES, keypoint_axes
from poem_jax.fitting.kinematics import KeypointModel, keypoint_model, pose_keypoints
from poem_jax.geometry.cameras import projection_jacobian
from poem_jax.hand.model import HandModel
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import JOINT_NAMES, NUM_JOINTS
from poem_jax.synthetic import SyntheticConfig, SyntheticDataset
from poem_jax.synthetic.config import CameraConfig, CropConfig, OccluderConfig, SensorConfig

IMAGE_PX = 384
"""More than the detector's 224, less than would cost time."""
MAX_DISTANCE = 0.2
"""As a share of the hand's extent in the picture: a detection that is farther off is of something else."""
TUNING_M = 0.004
"""Scale of the robust weights: about the spread of the detector in one view."""
_ROUNDS = 20


class Residuals(NamedTuple):
    """Detected minus true key points in one view, in metres at the depth of the hand."""

    hand: int
    offset_m: np.ndarray
    """(21, 2)."""
    map: np.ndarray
    """(21, 2, 3): by how much an offset (along, dorsal, thumbwards) moves them."""
    visible: np.ndarray
    """(21,): the others are guesses."""


def rendered_hands(views: int, seed: int) -> SyntheticDataset:
    """Return hands in full sight, seen sharply from anywhere."""
    config = SyntheticConfig(
        image_hw=(IMAGE_PX, IMAGE_PX),
        num_views=views,
        cameras=CameraConfig(distance_m=(0.4, 0.9), roll_deg=(0.0, 0.0)),
        crop=CropConfig(expand_ratio=2.2),
        occluders=OccluderConfig(held_probability=0, blocker_probability=0, stray_probability=0),
        sensor=SensorConfig(blur_px=(0, 0.6), motion_probability=0, noise=(0, 3), jpeg_quality=(80, 95)),
    )
    return SyntheticDataset(config, seed)


def upright(image: np.ndarray, keypoints_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turn a picture by quarters until the middle finger points up; return it and T (3, 3) of its pixels."""
    u, v = keypoints_px[9] - keypoints_px[0]
    quarters = int(np.round((np.arctan2(v, u) + np.pi / 2) / (np.pi / 2))) % 4
    turn = np.eye(3)
    for _ in range(quarters):
        # A quarter turn against the clock as one sees it: (u, v) -> (v, size - u).
        turn = np.array([[0, 1, 0], [-1, 0, IMAGE_PX], [0, 0, 1.0]]) @ turn
    return np.ascontiguousarray(np.rot90(image, quarters)), turn


def detection_of(found: list[DetectedHand], keypoints_px: np.ndarray, side: str) -> np.ndarray | None:
    """Return the key points of the detection that is of this hand; None if there is none."""
    extent = np.ptp(keypoints_px, axis=0).max()
    for hand in found:
        distance = np.median(np.linalg.norm(hand.keypoints_px - keypoints_px, axis=-1))
        if hand.side == side and distance < MAX_DISTANCE * extent:
            return hand.keypoints_px
    return None


def residuals_of_hand(dataset: SyntheticDataset, index: int, model: KeypointModel) -> list[Residuals]:
    """Draw a hand, look for it in all its views, and compare."""
    sample = dataset.render_sample(index)
    batch = sample.batch
    posed = pose_keypoints(model, batch.pose, batch.shape)
    axes = np.einsum("jab,jcb->jac", np.asarray(posed.blended), keypoint_axes(model.hand))
    _, jacobian = projection_jacobian(*batch.cameras[:2], batch.joints_world)
    pictures = [upright(*both) for both in zip(batch.views, batch.keypoints_px, strict=True)]
    found = find_hands([image for image, _ in pictures], max_hands=1)
    residuals = []
    for view, (_, turn) in enumerate(pictures):
        true = batch.keypoints_px[view] @ turn[:2, :2].T + turn[:2, 2]
        seen = detection_of(found[view], true, model.hand.side)
        if seen is None:
            continue
        metres = _metres_per_pixel(batch.cameras, batch.joints_world, view)
        offset = (seen - true) @ turn[:2, :2] * metres
        moved = np.einsum("juc,jca->jua", np.asarray(jacobian)[view], axes) * metres
        residuals.append(Residuals(index, offset, moved, sample.joint_visible[view]))
    return residuals


def _metres_per_pixel(cameras, joints_world: np.ndarray, view: int) -> float:
    depth = (
        joints_world @ cameras.T_cam_from_world[view, 2, :3] + cameras.T_cam_from_world[view, 2, 3]
    ).mean()
    return float(depth / np.sqrt(cameras.K[view, 0, 0] * cameras.K[view, 1, 1]))


def robust_offset(map_: np.ndarray, offset_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve map (n, 2, 3) x = offset (n, 2) by reweighting (Geman and McClure); return x and the weights."""
    weights = np.ones(len(offset_m))
    x = np.zeros(3)
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)[:, None]
        x = np.linalg.lstsq((root[..., None] * map_).reshape(-1, 3), (root * offset_m).ravel(), rcond=None)[0]
        square = ((map_ @ x - offset_m) ** 2).sum(-1)
        weights = (1 + square / (2 * TUNING_M) ** 2) ** -2
    return x, weights


def standard_error(
    map_: np.ndarray, offset_m: np.ndarray, weights: np.ndarray, x: np.ndarray, hands: np.ndarray
):
    """Return the standard error of x, hands being independent and views of one hand not (a sandwich)."""
    information = np.einsum("n,nui,nuj->ij", weights, map_, map_)
    each = np.einsum("n,nui,nu->ni", weights, map_, offset_m - map_ @ x)
    sums = np.stack([each[hands == hand].sum(0) for hand in np.unique(hands)])
    inverse = np.linalg.inv(information)
    return np.sqrt(np.diagonal(inverse @ (sums.T @ sums) @ inverse))


def measure(dataset: SyntheticDataset, hand: HandModel, hands: int) -> list[Residuals]:
    """Return the residuals of all views of the first `hands` hands in which the hand was found."""
    model = keypoint_model(hand)
    return [one for index in range(hands) for one in residuals_of_hand(dataset, index, model)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hands", type=int, default=150)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    dataset = rendered_hands(arguments.views, arguments.seed)
    residuals = measure(dataset, default_hand(), arguments.hands)
    print(f"found in {len(residuals)} of {arguments.hands * arguments.views} views")
    print(f"{'':12} {' '.join(f'{name:>16}' for name in AXIS_NAMES)}  before after, mm; views")
    for joint in range(NUM_JOINTS):
        seen = [one for one in residuals if one.visible[joint]]
        hands = np.array([one.hand for one in seen])
        map_, offset = (np.stack([getattr(one, name)[joint] for one in seen]) for name in ("map", "offset_m"))
        x, weights = robust_offset(map_, offset)
        error = standard_error(map_, offset, weights, x, hands)
        before, after = (1e3 * np.median(np.linalg.norm(r, axis=-1)) for r in (offset, offset - map_ @ x))
        row = " ".join(f"{1e3 * value:8.1f} +- {1e3 * s:4.1f}" for value, s in zip(x, error, strict=True))
        print(f"{JOINT_NAMES[joint]:12} {row}  {before:6.1f} {after:5.1f} {len(seen):5}")


if __name__ == "__main__":
    main()
