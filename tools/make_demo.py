"""Make the take that ships: `python tools/make_demo.py [--out poem_jax/capture/demo]`.

Four videos of `poem_jax.synthetic.desk`, the calibration file that anipose would write of its cameras, and
the true hands. Takes a few minutes; pictures and truth are the same on every run.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from poem_jax.calibration.write_calibration import write_calibration
from poem_jax.capture.demo import TRUTH, demo_folder
from poem_jax.synthetic.desk.cameras import FRAMES_PER_SECOND, SIZE_WH, desk_rig, frame_times
from poem_jax.synthetic.desk.motion import SHAPE, SIDES, hands_at
from poem_jax.synthetic.desk.take import desk_pictures

CALIBRATION = "calibration.toml"


def write_videos(out: Path) -> None:
    """Draw all frames; every camera's go to its own file."""
    names = desk_rig().names
    # MPEG-4 part 2: every OpenCV reads and writes it; some 7 kB a frame here.
    code = cv2.VideoWriter.fourcc(*"mp4v")
    videos = [cv2.VideoWriter(str(out / f"{name}.mp4"), code, FRAMES_PER_SECOND, SIZE_WH) for name in names]
    for frame in tqdm(range(len(frame_times())), unit="frame"):
        for video, picture in zip(videos, desk_pictures(frame), strict=True):
            video.write(np.ascontiguousarray(picture.image[..., ::-1]))
    for video in videos:
        video.release()


def write_truth(out: Path) -> None:
    """Write poses, shape and places, as float32; the meshes follow from them."""
    times = frame_times()
    moments = [hands_at(time) for time in times]
    np.savez_compressed(
        out / TRUTH,
        hand_side=np.array(SIDES),
        time_s=times,
        pose=np.stack([hands.pose for hands in moments]),
        translation=np.stack([hands.translation for hands in moments]),
        shape=SHAPE,
    )


def main() -> None:
    """Write all of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=demo_folder())
    out = parser.parse_args().out
    write_truth(out)
    write_calibration(out / CALIBRATION, desk_rig(), "anipose")
    write_videos(out)


if __name__ == "__main__":
    main()
