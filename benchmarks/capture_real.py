"""Rows of `benchmarks/capture.py` about recordings: real ones, where `--data` has them, and the demo's."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import jax
import numpy as np

import poem_jax
from poem_jax.calibration.read_calibration import read_calibration
from poem_jax.calibration.write_calibration import write_calibration
from poem_jax.capture.boxes_file import read_boxes
from poem_jax.data.lens import ideal_pixels, project_raw
from poem_jax.fitting import KeypointNoise, Observations, triangulate_robust
from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.geometry.triangulation import triangulate
from poem_jax.hand.topology import BONES
from poem_jax.typing import Array

VIDEOS, RIGS = "caliscope_4cam_video", "caliscope_4cam_hands"
FILES = (
    "rig.json",
    "anipose.toml",
    "caliscope_config.toml",
    "opencv_rig.yml",
    "easymocap",
    "colmap",
    "transforms.json",
)
"""The rig of the videos as written by one tool after the other; caliscope's is the original."""
WRITTEN = {
    "rig": "rig.json",
    "opencv": "opencv.yml",
    "anipose": "anipose.toml",
    "colmap": "colmap",
    "nerfstudio": "transforms.json",
    "easymocap": "easymocap",
    "panoptic": "panoptic.json",
    "voxelpose": "voxelpose.json",
    "openpose": "openpose",
}
"""Files of the formats that we write; Kalibr's does not hold the fifth term of these lenses."""
SQUARES, SQUARE_M = (4, 5), 0.054
"""The ChArUco board that is in the videos, white on black."""
DEMO = Path(poem_jax.__file__).parent / "capture" / "demo"
ROOT = Path(__file__).resolve().parents[1]


def formats(data: Path) -> None:
    """Compare where the files of one rig image a point: those that others made, and those we write."""
    for name in (RIGS, "caliscope_4cam_board"):
        folder = data / name / "calibration"
        if not folder.is_dir():
            print(f"formats: skipped, no {folder}; give --data")
            continue
        rig = read_calibration(folder / "rig.json")
        off = {file: pixels_apart(rig, read_calibration(folder / file)) for file in FILES[1:]}
        with tempfile.TemporaryDirectory() as place:
            for format, file in WRITTEN.items():
                path = write_calibration(Path(place, file), rig, format)
                off[f"written as {format}"] = pixels_apart(rig, read_calibration(path))
        worst = max(off, key=lambda file: off[file])
        print(f"formats, {name}: {len(off)} files, at most {off[worst]:.1e} px apart ({worst})")


def pixels_apart(a: Rig, b: Rig) -> float:
    """Return the largest distance between a point's places in two rigs' images."""
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (500, 3))
    most = 0.0
    for view in range(a.num_views):
        off = np.abs(project_raw(a, view, points)[0] - project_raw(b, view, points)[0])
        most = max(most, float(np.nanmax(off)))
    return most


def linter(data: Path) -> None:
    """Count the planted faults that are named right: those of tests/calibration/planted_faults.py."""
    if not (data / RIGS).is_dir():
        print(f"linter: on the drawn rig alone, no {data / RIGS}")
    command = [sys.executable, "-m", "pytest", "tests/calibration/test_linter.py", "-m", "", "-p", "no:xdist"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    said = (done.stdout + done.stderr).strip().splitlines()
    print(f"linter: faults and good rigs, {said[-1]} (exit code {done.returncode}; aim: all)")


def videos(data: Path) -> None:
    """Reconstruct four real videos by one command with each file of their rig; then the checks in metres."""
    folder = data / VIDEOS
    if not folder.is_dir():
        print(f"videos: skipped, no {folder}; give --data")
        return
    calibrations = data / RIGS / "calibration"
    with tempfile.TemporaryDirectory() as place:
        for name in FILES:
            report = reconstruct(folder, calibrations / name, Path(place, name))
            print(
                f"videos, {name}: {report['reprojection']['median_px']:.2f} px in the median, engine "
                f"{report['engine']}, {report['solved_hands']} of {report['num_hands']} hands, "
                f"{report['timings_s']['total']:.0f} s"
            )
        out = Path(place, "poem")
        reconstruct(folder, calibrations / "rig.json", out, "--engine", "poem", "--video")
        rig = read_calibration(calibrations / "rig.json")
        print_bones("key points triangulated frame by frame", triangulated(rig, out / "keypoints.npz"), 3)
        with np.load(out / "prediction.npz") as prediction:
            print_bones("--engine poem", prediction["joints_world"], 5)
        print_board(rig, folder)


def reconstruct(folder: Path, rig: Path, out: Path, *options: str) -> dict:
    """Run `poem reconstruct` and return its report."""
    poem = [sys.executable, "-m", "poem_jax.cli", "reconstruct", str(folder), "--rig", str(rig)]
    done = subprocess.run([*poem, "--out", str(out), *options], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"poem reconstruct ended with {done.returncode}: {done.stderr[-2000:]}")
    return json.loads((out / "report.json").read_text())


def triangulated(rig: Rig, keypoints: Path) -> Array:
    """Return joints (frame, hand, 21, 3), NaN = unknown, of detected key points."""
    hands = read_boxes(keypoints)
    assert hands.keypoints_px is not None
    raw = np.moveaxis(hands.keypoints_px, 2, 0)
    ideal = np.stack([ideal_pixels(raw[v], rig.K[v], rig.dist[v]) for v in range(rig.num_views)], 2)
    seen = Observations(ideal, hands.confidence, rig.K, rig.T_cam_from_world)
    noise = KeypointNoise.of_images(rig.size_wh)
    points = jax.jit(lambda seen: triangulate_robust(seen, noise=noise, frame_axis=0))(seen)
    return np.where(points.valid[..., None], points.points, np.nan)


def print_bones(name: str, joints: Array, aim_mm: int) -> None:
    """Print how much the lengths of bones vary over the frames, (frame, hand, 21, 3)."""
    start, end = np.array(BONES).T
    lengths_mm = 1000 * np.linalg.norm(joints[:, :, end] - joints[:, :, start], axis=-1)
    spread = np.nanstd(lengths_mm, axis=0)
    print(
        f"bones, {name}: standard deviation {np.median(spread):.1f} mm in the median of {spread.size} bones, "
        f"mean {spread.mean():.1f}, worst {spread.max():.1f} (aim {aim_mm})"
    )


def print_board(rig: Rig, folder: Path) -> None:
    """Triangulate the corners of the board and compare neighbours' distances with its squares."""
    detector = board_detector()
    sides: list[Array] = []
    for images in images_of(rig, folder):
        found = [detector.detectBoard(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))[:2] for image in images]
        columns, rows = SQUARES[0] - 1, SQUARES[1] - 1
        uv = np.full((rig.num_views, columns * rows, 2), np.nan)
        for view, (corners, ids) in enumerate(found):
            if ids is not None:
                seen = corners.reshape(-1, 2) + HALF_PIXEL
                uv[view, ids.ravel()] = ideal_pixels(seen, rig.K[view], rig.dist[view])
        points, valid = triangulate(uv, rig.K, rig.T_cam_from_world)
        grid = np.where(np.asarray(valid)[:, None], points, np.nan).reshape(rows, columns, 3)
        for axis in (0, 1):
            step = np.linalg.norm(np.diff(grid, axis=axis), axis=-1)
            sides.append(step[np.isfinite(step)])
    lengths_mm = 1000 * np.concatenate(sides)
    off = 100 * (np.median(lengths_mm) / (1000 * SQUARE_M) - 1)
    print(
        f"board: {lengths_mm.size} sides of squares, {np.median(lengths_mm):.2f} mm in the median, of "
        f"{1000 * SQUARE_M:.0f} on the board ({off:+.2f} %), standard deviation {lengths_mm.std():.2f} mm"
    )


def board_detector() -> cv2.aruco.CharucoDetector:
    """Return OpenCV's detector of the board."""
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    settings = cv2.aruco.DetectorParameters()
    settings.detectInvertedMarker = True
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, 0.75 * SQUARE_M, markers)
    return cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), settings)


def images_of(rig: Rig, folder: Path) -> Iterator[list[Array]]:
    """Read the videos side by side to the end of the shortest."""
    captures = [cv2.VideoCapture(str(folder / f"{name}.mp4")) for name in rig.names]
    while True:
        read = [capture.read() for capture in captures]
        if not all(ok for ok, _ in read):
            return
        yield [image for _, image in read]


def live(_: Path) -> None:
    """Run `poem live` for a minute on the demo's four videos, as if they were filmed now."""
    poem = [sys.executable, "-m", "poem_jax.cli", "live", "--rig", str(DEMO / "calibration.toml"), "--source"]
    options = [str(DEMO), "--loop", "--seconds", "60", "--viewer", "0"]
    command = [*poem, *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True)
    print(f"live: {done.stdout.strip().splitlines()[-1]}")
