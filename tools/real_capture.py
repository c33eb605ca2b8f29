"""Reconstruct a real capture and measure the distance to its triangulated key points.

    python tools/real_capture.py ../shared/data/caliscope_4cam_hands --out out/real [--checkpoint DIR]

The folder holds `frames/`, `calibration/rig.json` and `pseudo_gt.npz` (2D key points of a detector in the raw
images, and their linear triangulation). The 2D points become the key-point file of `poem reconstruct`; the 3D
points are what the predicted joints are compared with. They are no ground truth: their own error is several
millimetres.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from poem_jax.capture.pipeline import reconstruct
from poem_jax.capture.take import read_take
from poem_jax.geometry.alignment import apply_similarity, procrustes
from poem_jax.hand.topology import WRIST

SIDES = ("right", "left")


def read_pseudo_truth(path: Path) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return key points (F, 2, V, 21, 2), joints (F, 2, 21, 3) and frame numbers; NaN = not there."""
    with np.load(path) as stored:
        frames = sorted({int(frame) for frame in stored["frame"]})
        views = stored["keypoints_2d"].shape[1]
        keypoints = np.full((len(frames), len(SIDES), views, 21, 2), np.nan)
        joints = np.full((len(frames), len(SIDES), 21, 3), np.nan)
        for row, (frame, side) in enumerate(zip(stored["frame"], stored["hand_side"], strict=True)):
            place = frames.index(int(frame)), SIDES.index(str(side))
            keypoints[place] = stored["keypoints_2d"][row]
            joints[place] = stored["joints_3d_world"][row]
    return keypoints, joints, frames


def distances_mm(predicted: np.ndarray, expected: np.ndarray) -> dict[str, float]:
    """Return mean joint distances (hand, 21, 3) in millimetres: as they are, wrist at wrist, and aligned."""

    def mean(points: np.ndarray) -> float:
        return float(1e3 * np.linalg.norm(points - expected, axis=-1).mean())

    wrist = predicted[:, WRIST : WRIST + 1] - expected[:, WRIST : WRIST + 1]
    per_hand = 1e3 * np.linalg.norm(predicted - expected, axis=-1).mean(-1)
    return {
        "mpjpe_mm": mean(predicted),
        "median_mm": float(np.median(per_hand)),
        "worst_mm": float(per_hand.max()),
        "rr_mpjpe_mm": mean(predicted - wrist),
        "pa_mpjpe_mm": mean(apply_similarity(procrustes(predicted, expected), predicted)),
        "hands": len(predicted),
    }


def main() -> None:
    """Run the reconstruction and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--checkpoint", type=Path)
    arguments = parser.parse_args()
    keypoints, joints, frames = read_pseudo_truth(arguments.folder / "pseudo_gt.npz")
    boxes = arguments.out / "keypoints.npz"
    arguments.out.mkdir(parents=True, exist_ok=True)
    np.savez(boxes, keypoints_px=keypoints, hand_side=SIDES, frames=frames)
    written = reconstruct(
        read_take(arguments.folder, boxes=boxes),
        arguments.out,
        engine="poem",
        checkpoint=arguments.checkpoint,
    )
    arrays, table = written.arrays, {}
    for hand, side in [*enumerate(SIDES), (slice(None), "both")]:
        both = arrays["joints_world"][:, hand].reshape(-1, 21, 3), joints[:, hand].reshape(-1, 21, 3)
        known = np.isfinite(both[0]).all((-1, -2)) & np.isfinite(both[1]).all((-1, -2))
        table[side] = distances_mm(both[0][known].astype(np.float64), both[1][known])
    table["reprojection"] = written.report["reprojection"]
    text = json.dumps(table, indent=1)
    (arguments.out / "distances.json").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
