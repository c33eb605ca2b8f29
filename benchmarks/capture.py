"""What a take of several cameras costs: `python benchmarks/capture.py [--only ROW] [--data FOLDER]`.

A row is a function that prints what it measured; `ROWS` lists them.

    detection   frames a second of the search for hands in four real videos (--data: the folder `data` of the
                reference material, with caliscope_4cam_video and caliscope_4cam_hands)
    fit         frames a second of the fit of 4 cameras and two hands, key points given, files written
    smoothing   how much hands tremble, and how late they are, before they are smoothed and after
    formats     how far the files of one rig are apart, in pixels
    linter      planted faults of calibrations that are named right
    videos      `poem reconstruct` on four real videos with seven files of their rig, then the lengths of
                bones and of the squares of the board that is in view
    live        how far `poem live` is behind, on the demo's videos
    memory      memory of a search, then of a fit, after 200 and after 2,000 frames of a synthetic take
"""

import argparse
import logging
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from capture_real import formats, linter, live, videos
from capture_smoothing import smoothing

from poem_jax.calibration.rig_json import read_rig, write_rig
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints, write_boxes
from poem_jax.capture.detect import detect_hands
from poem_jax.capture.detections import SearchFile
from poem_jax.capture.moments import find_moments
from poem_jax.capture.pipeline import fit
from poem_jax.capture.take import Take, make_take, read_keypoint_take
from poem_jax.data.capture_folder import FramePaths
from poem_jax.data.lens import project_raw
from poem_jax.detection import DetectedHand
from poem_jax.geometry.rig import Rig
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.io.compilation_cache import use_compilation_cache
from poem_jax.synthetic.keypoint_takes import IMAGE_WH, draw_keypoint_take

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
FRAMES, EARLY = 2000, 200
FIT_FRAMES = 640
HANDS = ("right", "left")
SIZE_WH = (320, 240)


def detection(data: Path) -> None:
    """Search four real videos of 34 frames, 1280 x 720, both hands, as `poem detect` does."""
    folder = data / "caliscope_4cam_video"
    if not folder.is_dir():
        print(f"detection: skipped, no {folder}; give --data")
        return
    rig = read_rig(data / "caliscope_4cam_hands" / "calibration" / "rig.json")
    frames = find_moments(folder, rig).frames
    for video in (True, False):
        detect_hands(frames[:2], rig, video=video, progress=False)
        seconds, cpu_seconds = [], []
        for _ in range(3):
            start, cpu_start = time.perf_counter(), time.process_time()
            detect_hands(frames, rig, video=video, progress=False)
            seconds.append(time.perf_counter() - start)
            cpu_seconds.append(time.process_time() - cpu_start)
        how = "hands followed" if video else "each image by itself"
        print(
            f"detection, {how}: {len(frames) / np.median(seconds):.2f} frames/s of {rig.num_views} cameras "
            f"(median of {len(seconds)}, association and decoding in it), "
            f"{np.median(cpu_seconds) / len(frames):.2f} CPU seconds a frame"
        )


def fit_row(_: Path) -> None:
    """Fit key points that are given, the whole way to the files, and say where the time goes.

    There are no images, so that no overlay is drawn; what compiles does so in a shorter take before.
    """
    with tempfile.TemporaryDirectory() as folder:
        fit(keypoint_take(128), Path(folder) / "first", progress=False)
        written = fit(keypoint_take(FIT_FRAMES), Path(folder) / "out", progress=False)
        spent = written.report["timings_s"]
    total = spent.pop("total")
    shares = ", ".join(f"{name} {100 * s / total:.0f} %" for name, s in spent.items() if s > 0.01 * total)
    print(f"fit: {FIT_FRAMES / total:.1f} frames/s of 4 cameras and {len(HANDS)} hands ({shares})")


def keypoint_take(num_frames: int) -> Take:
    """Return both hands of a synthetic take in one rig, as key points without images."""
    drawn = [draw_keypoint_take(default_hand(side), num_frames, 4, 2.0, 7) for side in HANDS]
    rig = Rig(
        tuple(f"cam_{view}" for view in range(4)),
        np.tile(IMAGE_WH, (4, 1)),
        drawn[0].K.astype(np.float64),
        np.zeros((4, 5)),
        drawn[0].T_cam_from_world.astype(np.float64),
    )
    keypoints = np.stack([take.uv_px for take in drawn], 1).astype(np.float64)
    names = tuple(f"{frame:05d}" for frame in range(num_frames))
    hands = HandBoxes(boxes_from_keypoints(keypoints), HANDS, names, keypoints)
    return make_take(rig, [FramePaths(name, (None,) * 4) for name in names], hands)


def memory(_: Path) -> None:
    """Compare the memory of the process early in a take with the most that it ever takes after that."""
    rig = four_cameras()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_rig(folder / "rig.json", rig)
        write_videos(folder, rig)
        frames = find_moments(folder, rig).frames
        found = folder / "keypoints.npz"
        search = MemoryOfTake(range(FRAMES))
        file = SearchFile(folder / "keypoints.search", "benchmark")
        seen = planted(rig, iter(search))
        hands = detect_hands(frames, rig, video=True, detector=seen, file=file, progress=False)
        write_boxes(found, hands._replace(detector="mediapipe-hands"))
        search.report("search")
        take = read_keypoint_take(found, images=folder)
        fitted = MemoryOfTake(take.frames)
        fit(take._replace(frames=fitted), folder / "out", progress=False)
        fitted.report("fit")


class MemoryOfTake:
    """A stream that notes the memory of this process, MB, with every frame that is taken from it."""

    def __init__(self, frames: Any) -> None:
        self._frames = frames
        self._noted: list[float] = []

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[Any]:
        for frame in self._frames:
            self._noted.append(resident_mb())
            yield frame

    def report(self, name: str) -> None:
        """Print what the process took after some frames, and the most of any moment after them."""
        early, most = self._noted[EARLY], max(*self._noted[EARLY:], resident_mb())
        grown = 100 * (most / early - 1)
        print(
            f"memory, {name}: {early:.0f} MB after {EARLY} frames, at most {most:.0f} MB in {FRAMES} "
            f"({grown:+.1f} %); most of the process so far {peak_mb():.0f} MB"
        )


def resident_mb() -> float:
    """Return the memory of this process (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def peak_mb() -> float:
    """Return the most memory that this process ever had (Linux)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def four_cameras() -> Rig:
    """Cameras on a circle, 0.8 m from the middle."""
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    T_cam_from_world = np.tile(np.eye(4), (4, 1, 1))
    for view, angle in enumerate(np.arange(4) * np.pi / 2):
        c, s = np.cos(angle), np.sin(angle)
        T_cam_from_world[view, :3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        T_cam_from_world[view, 2, 3] = 0.8
    names = tuple(f"cam_{view}" for view in range(4))
    return Rig(names, np.tile(SIZE_WH, (4, 1)), np.tile(K, (4, 1, 1)), np.zeros((4, 5)), T_cam_from_world)


def write_videos(folder: Path, rig: Rig) -> None:
    """Write a video of smooth noise for each camera."""
    rng = np.random.default_rng(0)
    for name in rig.names:
        noise = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8)
        image = cv2.resize(noise, SIZE_WH, interpolation=cv2.INTER_CUBIC)
        writer = cv2.VideoWriter(str(folder / f"{name}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, SIZE_WH)
        for frame in range(FRAMES):
            writer.write(np.roll(image, frame, axis=1))
        writer.release()


def planted(rig: Rig, turns: Iterator[int]) -> Callable[..., list[list[DetectedHand]]]:
    """Return a detector that sees two hands that move, with a pixel of noise."""
    rng = np.random.default_rng(1)
    joints = {}
    for side, x in (("right", 0.12), ("left", -0.12)):
        hand = np.asarray(hand_mesh(default_hand(side), np.zeros((16, 3)), np.zeros(10), np.zeros(3)).joints)
        joints[side] = hand - hand[9] + [x, 0, 0]

    def sees(view: int, side: str, moved: np.ndarray) -> DetectedHand:
        px = project_raw(rig, view, joints[side] + moved)[0]
        return DetectedHand(px + rng.normal(0, 1, (21, 2)), side, 0.95, 0.95)

    def detect(views: list[int], _: list[np.ndarray]) -> list[list[DetectedHand]]:
        phase = next(turns) / 20
        moved = 0.05 * np.array([0, np.sin(phase), np.cos(phase)])
        return [[sees(view, side, moved) for side in joints] for view in views]

    return detect


ROWS: dict[str, Callable[[Path], None]] = {
    "detection": detection,
    "fit": fit_row,
    "memory": memory,
    "smoothing": lambda _: smoothing(),
    "formats": formats,
    "linter": linter,
    "videos": videos,
    "live": live,
}
"""Every row takes the folder of real data."""


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", choices=list(ROWS), help="one row")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of real data")
    given = parser.parse_args()
    use_compilation_cache()
    logging.disable(logging.WARNING)
    for name, row in ROWS.items():
        if given.only in (None, name):
            row(given.data)


if __name__ == "__main__":
    main()
