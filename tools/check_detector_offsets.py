"""Hold fitted hands against the outlines of real ones, with and without the calibration of our detector.

    python tools/check_detector_offsets.py ../shared/data/caliscope_4cam_hands --views cam_2 cam_3 \
        --leave-out 0075 0090 --out out/outlines

The folder holds `frames/` and `calibration/rig.json`. Hands are found by our detector, fitted, and drawn over
the undistorted images. Their true outline is found by GrabCut, begun around the detected key points (not the
fit, which is to be judged); it needs hands before something of another colour, so name the views where they
are. Compared are, in views whose own key points the plain fit meets to `MAX_REPROJECTION_PX`,

    IoU     of mesh and outline, from the middle of the palm to the tips: outlines know no wrist
    gap     from the end of the mesh to the end of the skin, along the last bone of every finger that lies
            across the view: positive = the mesh is too short; millimetres at the depth of the tip
    short   from the detected tip to the end of the skin: what the calibration of the tips is made of

Writes a picture of every hand and view: outline green, mesh without calibration blue, with it red.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.capture.detect import detect_hands
from poem_jax.data.capture_folder import find_frames, find_rig
from poem_jax.fitting import FitConfig, FitResult, KeypointNoise, Observations, fit_take, keypoint_model
from poem_jax.fitting.detector_offsets import DETECTORS, MEDIAPIPE_HANDS, KeypointOffsets
from poem_jax.geometry.cameras import project
from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import BONES, FINGER_JOINTS, FINGER_NAMES, PALM_JOINTS, ROOT_JOINT, WRIST
from poem_jax.io.images import read_image
from poem_jax.render.zbuffer import rasterise

MAX_REPROJECTION_PX = 6.0
"""Views with more are out of step with the others, or of another hand: no mesh can fit them."""
SCALE = 2
"""Picture pixels per pixel: outlines are found between pixels."""
PALM_M = 0.095
"""Wrist to middle knuckle of an adult, which sizes the first guess of the outline."""
BONE_M, FLESH_M, NEAR_M = 0.003, 0.009, 0.022
"""Distance from the detected bones within which all is hand, much is, and beyond which nothing is."""
PALM_SHARE = 0.35
"""Of the palm, from the wrist: below it outlines are cut where the guess ended, and not counted."""
MIN_ACROSS = 0.8
"""A bone shorter than this in a view, as a share of its length, points at the camera or away."""
MAX_GAP_M = 0.02
"""What ends farther off is another finger, or the outline failed."""
_ROUNDS = 5


class Picture(NamedTuple):
    """One hand in one view."""

    image: np.ndarray
    corner_px: np.ndarray
    """Of the undistorted image."""
    keypoints: np.ndarray
    """(21, 2), pixels of the picture."""
    outline: np.ndarray
    """True on the hand."""


def picture_of(image: np.ndarray, keypoints_px: np.ndarray) -> Picture:
    """Cut a hand out of an undistorted image and find its outline."""
    low, high = keypoints_px.min(0), keypoints_px.max(0)
    half = 0.85 * (high - low).max()
    corner = np.floor((low + high) / 2 - half)
    size = int(np.ceil(2 * half)) * SCALE
    at = corner + 0.5 / SCALE - HALF_PIXEL
    warp = np.array([[1 / SCALE, 0, at[0]], [0, 1 / SCALE, at[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    picture = cv2.warpAffine(image, warp, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    keypoints = (keypoints_px - corner) * SCALE
    return Picture(picture, corner, keypoints, outline_of(picture, keypoints))


def outline_of(image: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Return where the hand is, by the colours near and far from the detected bones (GrabCut)."""
    palm = np.linalg.norm(keypoints[ROOT_JOINT] - keypoints[WRIST])
    per_metre = max(palm, 0.55 * np.ptp(keypoints, axis=0).max()) / PALM_M
    marks = np.full(image.shape[:2], cv2.GC_BGD, np.uint8)
    for reach, mark in ((NEAR_M, cv2.GC_PR_BGD), (FLESH_M, cv2.GC_PR_FGD), (BONE_M, cv2.GC_FGD)):
        for bone in BONES:
            start, end = (tuple(map(int, keypoints[joint])) for joint in bone)
            cv2.line(marks, start, end, mark, max(1, int(2 * reach * per_metre)))
        cv2.fillPoly(marks, [keypoints[list(PALM_JOINTS)].astype(np.int32)], mark)
    cv2.grabCut(
        image, marks, (0, 0, 1, 1), np.zeros((1, 65)), np.zeros((1, 65)), _ROUNDS, cv2.GC_INIT_WITH_MASK
    )
    return (marks == cv2.GC_FGD) | (marks == cv2.GC_PR_FGD)


def undistorted(rig: Rig, view: int, path: Path) -> np.ndarray:
    """Read an image as a pinhole with the rig's `K` would have taken it, BGR."""
    K = rig.K[view].copy()
    K[:2, 2] -= HALF_PIXEL
    width, height = (int(size) for size in rig.size_wh[view])
    return cv2.undistort(read_image(path, (width, height))[..., ::-1].copy(), K, rig.dist[view])


def fit_both(
    rig: Rig, keypoints_px: np.ndarray, sides: tuple[str, ...], detector: KeypointOffsets | None
) -> list[FitResult]:
    """Fit every hand of a take (frame, hand, view, 21, 2)."""
    config = FitConfig(noise=KeypointNoise.of_images(rig.size_wh))
    results = []
    for hand, side in enumerate(sides):
        seen = Observations(keypoints_px[:, hand], None, rig.K, rig.T_cam_from_world)
        model = keypoint_model(default_hand(side), detector)
        results.append(jax.device_get(fit_take(model, seen, config=config)))
    return results


class Drawn(NamedTuple):
    """A fitted hand in a picture."""

    silhouette: np.ndarray
    joints: np.ndarray
    """(21, 2), pixels of the picture."""
    px_per_m: np.ndarray
    """(21,), at the depth of each joint."""
    joints_m: np.ndarray


def drawn(rig: Rig, view: int, fitted: FitResult, frame: int, side: str, picture: Picture) -> Drawn:
    """Draw a fit into a picture."""
    K, T = rig.K[view], rig.T_cam_from_world[view]

    def seen(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = points.astype(np.float64)
        return (project(K, T, points)[0] - picture.corner_px) * SCALE, points @ T[2, :3] + T[2, 3]

    vertices, depth = seen(fitted.vertices[frame])
    faces = np.asarray(default_hand(side).faces)
    raster = rasterise(np.column_stack([vertices, depth]), faces, picture.outline.shape)
    joints, depth = seen(fitted.joints[frame])
    return Drawn(raster.face_index >= 0, joints, SCALE * K[0, 0] / depth, fitted.joints[frame])


def overlap(picture: Picture, silhouette: np.ndarray) -> float:
    """Return the IoU beyond the middle of the palm."""
    wrist = picture.keypoints[WRIST]
    palm = picture.keypoints[ROOT_JOINT] - wrist
    rows, columns = np.mgrid[: silhouette.shape[0], : silhouette.shape[1]] + 0.5
    along = ((columns - wrist[0]) * palm[0] + (rows - wrist[1]) * palm[1]) / (palm @ palm)
    counted = along > PALM_SHARE
    both, any_ = picture.outline & silhouette & counted, (picture.outline | silhouette) & counted
    return float(both.sum() / any_.sum())


def end_of(mask: np.ndarray, start: np.ndarray, direction: np.ndarray, reach: float) -> float:
    """Return how far from `start` a mask goes on along a direction, pixels; NaN if it begins elsewhere."""
    steps = np.arange(0, reach, 0.5)
    columns, rows = np.floor(start + steps[:, None] * direction).astype(int).T
    inside = (rows >= 0) & (columns >= 0) & (rows < mask.shape[0]) & (columns < mask.shape[1])
    on = inside & mask[np.where(inside, rows, 0), np.where(inside, columns, 0)]
    first = np.flatnonzero(~on[1:] & on[:-1])
    return float(steps[first[0]]) if on[0] and first.size else np.nan


def finger_ends(picture: Picture, hand: Drawn) -> np.ndarray:
    """Return gap and short (5, 2) of every finger, millimetres; NaN where a view does not show them."""
    ends = np.full((5, 2), np.nan)
    for row, (*_, joint, tip) in enumerate(FINGER_JOINTS):
        bone = hand.joints[tip] - hand.joints[joint]
        length, scale = np.linalg.norm(bone), hand.px_per_m[tip]
        true = np.linalg.norm(hand.joints_m[tip] - hand.joints_m[joint]) * scale
        if length < MIN_ACROSS * true:
            continue
        start, direction = hand.joints[joint], bone / length
        skin, mesh = (end_of(mask, start, direction, 3 * true) for mask in (picture.outline, hand.silhouette))
        detected = (picture.keypoints[tip] - start) @ direction
        found = 1e3 * np.array([skin - mesh, skin - detected]) / scale
        if abs(found[0]) < 1e3 * MAX_GAP_M and skin > 0.5 * true:
            ends[row] = found
    return ends


def draw(picture: Picture, plain: np.ndarray, calibrated: np.ndarray, text: str, path: Path) -> None:
    """Write a picture with its outlines."""
    image = picture.image.copy()
    for mask, color in ((picture.outline, (0, 220, 0)), (plain, (255, 120, 0)), (calibrated, (0, 0, 255))):
        lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, lines, -1, color, 1)
    cv2.putText(image, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
    cv2.imwrite(str(path), image)


def report(name: str, overlaps: np.ndarray, ends: np.ndarray) -> None:
    """Print the figures of one kind of fit: overlaps (picture,), ends (picture, 5, 2)."""
    gaps = ends[..., 0]
    print(f"{name}: IoU {overlaps.mean():.3f} (mean of {len(overlaps)}), {np.median(overlaps):.3f} (median)")
    print(f"  gap {np.nanmedian(gaps):.1f} mm (median), its size {np.nanmedian(np.abs(gaps)):.1f} mm")
    for finger, one in zip(FINGER_NAMES, np.moveaxis(ends, 1, 0), strict=True):
        gap, short = np.nanmedian(one, axis=0)
        print(f"  {finger:7} gap {gap:5.1f}  short {short:5.1f} mm  ({np.isfinite(one[:, 0]).sum()} views)")


def main() -> None:
    """Fit twice, compare and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", nargs="+", required=True)
    parser.add_argument("--leave-out", nargs="*", default=[])
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rig = find_rig(arguments.folder, None)
    frames = [one for one in find_frames(arguments.folder, rig.names) if one.name not in arguments.leave_out]
    hands = detect_hands(frames, rig)
    assert hands.keypoints_px is not None
    keypoints = ideal_keypoints(rig, hands.keypoints_px)
    kinds = {"none": None, MEDIAPIPE_HANDS: DETECTORS[MEDIAPIPE_HANDS]}
    fits = [fit_both(rig, keypoints, hands.hand_side, detector) for detector in kinds.values()]
    overlaps, ends = [], []
    for frame, paths in enumerate(frames):
        for view in (rig.names.index(name) for name in arguments.views):
            path = paths.images[view]
            if path is None:
                continue
            image = undistorted(rig, view, path)
            for hand, side in enumerate(hands.hand_side):
                fits_it = fits[0][hand].reprojection_px[frame, view] < MAX_REPROJECTION_PX
                if not fits_it or not np.isfinite(keypoints[frame, hand, view]).all():
                    continue
                picture = picture_of(image, keypoints[frame, hand, view])
                both = [drawn(rig, view, kind[hand], frame, side, picture) for kind in fits]
                overlaps.append([overlap(picture, one.silhouette) for one in both])
                ends.append([finger_ends(picture, one) for one in both])
                name = f"{paths.name}_{rig.names[view]}_{side}"
                text = "IoU {:.3f} -> {:.3f}".format(*overlaps[-1])
                draw(picture, both[0].silhouette, both[1].silhouette, text, arguments.out / f"{name}.png")
    for index, name in enumerate(kinds):
        report(name, np.array(overlaps)[:, index], np.array(ends)[:, index])


if __name__ == "__main__":
    main()
