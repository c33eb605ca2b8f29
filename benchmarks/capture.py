"""Speed of captures on this machine: `python benchmarks/capture.py [--only ROW]`.

    fit     key points given, engine fit: 4 cameras, two hands, the whole way from a take to its files,
            without images, so that no overlay is drawn

One function a row; each prints a line. What compiles does so in a shorter run before.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints
from poem_jax.capture.pipeline import reconstruct
from poem_jax.capture.take import Take, make_take
from poem_jax.data.capture_folder import FramePaths
from poem_jax.geometry.rig import Rig
from poem_jax.hand.template import default_hand
from poem_jax.io.compilation_cache import use_compilation_cache
from poem_jax.synthetic.keypoint_takes import IMAGE_WH, draw_keypoint_take

FRAMES, VIEWS, NOISE_PX = 640, 4, 2.0
SIDES = ("right", "left")


def keypoint_take(num_frames: int) -> Take:
    """Return both hands of a synthetic take in one rig, as key points without images."""
    drawn = [draw_keypoint_take(default_hand(side), num_frames, VIEWS, NOISE_PX, 7) for side in SIDES]
    rig = Rig(
        tuple(f"cam_{view}" for view in range(VIEWS)),
        np.tile(IMAGE_WH, (VIEWS, 1)),
        drawn[0].K.astype(np.float64),
        np.zeros((VIEWS, 5)),
        drawn[0].T_cam_from_world.astype(np.float64),
    )
    keypoints = np.stack([take.uv_px for take in drawn], 1).astype(np.float64)
    names = tuple(f"{frame:05d}" for frame in range(num_frames))
    hands = HandBoxes(boxes_from_keypoints(keypoints), SIDES, names, keypoints)
    return make_take(rig, [FramePaths(name, (None,) * VIEWS) for name in names], hands)


def fit() -> None:
    """Print frames a second of the fit, and where its time goes."""
    with tempfile.TemporaryDirectory() as folder:
        reconstruct(keypoint_take(64), Path(folder) / "first", engine="fit", progress=False)
        written = reconstruct(keypoint_take(FRAMES), Path(folder) / "out", engine="fit", progress=False)
        spent = written.report["timings_s"]
    shares = ", ".join(
        f"{name} {100 * seconds / spent['total']:.0f} %"
        for name, seconds in spent.items()
        if name != "total" and seconds > 0.01 * spent["total"]
    )
    print(f"fit: {FRAMES / spent['total']:.1f} frames/s of {VIEWS} cameras and {len(SIDES)} hands ({shares})")


ROWS = {"fit": fit}


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=ROWS, help="one row")
    only = parser.parse_args().only
    use_compilation_cache()
    for name, row in ROWS.items():
        if only in (None, name):
            row()


if __name__ == "__main__":
    main()
