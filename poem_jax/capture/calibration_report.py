"""A calibration's check from files to files: rig and key points in, findings, report and pictures out."""

import json
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.calibration.epipolar import epipolar_distances_px, ideal_keypoints
from poem_jax.calibration.findings import Finding
from poem_jax.calibration.meeting_points import meeting_points, near_rig
from poem_jax.capture.calibration_check import check_calibration
from poem_jax.capture.read import read_views
from poem_jax.capture.take import read_keypoint_take
from poem_jax.data.capture_folder import FramePaths, find_rig
from poem_jax.data.lens import project_raw
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid, transform_points
from poem_jax.io.atomic import whole_file
from poem_jax.io.writable import check_folder_is_writable
from poem_jax.typing import Array, Float
from poem_jax.viz.rig_picture import draw_keypoints, draw_rig, write_picture

_PICTURED_FRAMES = 3
_PICTURED_HANDS = 6


class CheckReport(NamedTuple):
    """What came of a check."""

    findings: list[Finding]
    summary: str
    """One line to say where nothing was found."""


class _Footage(NamedTuple):
    names: tuple[str, ...]
    images: list[FramePaths]
    """Of the same frames; empty where there are none."""


def check_files(
    rig_file: str | os.PathLike,
    keypoints: str | os.PathLike | None,
    images: str | os.PathLike | None,
    out: str | os.PathLike | None,
) -> CheckReport:
    """Check a calibration and write report and pictures.

    Args:
        rig_file: The calibration.
        keypoints: File of key points; None = the rig is looked at by itself.
        images: Capture folder to draw on; None = no images.
        out: Folder for `report.json`, `rig.png` and `<frame>_<camera>.jpg`; None = nothing is written.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: The key points cannot be read, or `out` cannot be written. A rig that cannot be read is a
            finding, `unreadable`.
    """
    if out is not None:
        check_folder_is_writable(out)
    try:
        rig = find_rig(".", rig_file)
    except ValueError as error:
        found = [Finding("unreadable", str(error), "correct the file, then check it again")]
        return _written(CheckReport(found, ""), None, None, None, out)
    if keypoints is None:
        findings = check_calibration(rig)
        summary = (
            f"nothing is wrong with the rig of {rig.num_views} cameras by itself; whether it fits what the "
            "cameras see is told by key points of hands (--keypoints, --images or --videos)"
        )
        return _written(CheckReport(findings, summary), rig, None, None, out)
    rig, hands, footage, time_s = read_rig_and_hands(rig_file, keypoints, images)
    findings = check_calibration(rig, hands, time_s)
    pairs = epipolar_distances_px(rig, ideal_keypoints(rig, hands[:_MOST_FRAMES]))
    worst = float(np.nanmax(pairs)) if np.isfinite(pairs).any() else np.nan
    summary = (
        f"nothing is wrong: the key points of {len(hands)} frames lie at most {worst:.1f} px off each "
        "other's epipolar lines (worst pair of cameras, median)"
    )
    return _written(CheckReport(findings, summary), rig, hands, footage, out)


_MOST_FRAMES = 400
"""Of which the pairs' distances are told."""


def read_rig_and_hands(
    rig_file: str | os.PathLike, keypoints: str | os.PathLike, images: str | os.PathLike | None
) -> tuple[Rig, Float[Array, "frame hand view 21 2"], _Footage, Float[Array, " frame"] | None]:
    """Read a rig and the key points of its cameras, in the rig's order.

    Returns: the rig, key points in pixels of the raw images (NaN = unseen), the frames' names and images, and
        their times in seconds, None where they are not known.
    """
    take = read_keypoint_take(keypoints, rig_file, images)
    frames = list(take.frames)
    points = [frame.keypoints_px for frame in frames if frame.keypoints_px is not None]
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    footage = _Footage(
        tuple(frame.name for frame in frames),
        [FramePaths(frame.name, frame.image_files or (None,) * take.rig.num_views) for frame in frames],
    )
    known = len(times) == len(frames) > 1
    return take.rig, np.stack(points).astype(np.float64), footage, np.array(times) if known else None


def _written(
    report: CheckReport,
    rig: Rig | None,
    hands: Array | None,
    footage: _Footage | None,
    out: str | os.PathLike | None,
) -> CheckReport:
    if out is None:
        return report
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "findings": [finding._asdict() for finding in report.findings],
        "cameras": [] if rig is None else list(rig.names),
        "frames": 0 if hands is None else len(hands),
        "pairs_px": None if rig is None or hands is None else _pairs(rig, hands),
    }
    if rig is not None:
        joints = np.zeros((0, 21, 3)) if hands is None else _joints_world(rig, hands)
        some = joints[np.linspace(0, len(joints) - 1, min(len(joints), _PICTURED_HANDS)).astype(int)]
        text = " ".join(map(str, report.findings))
        suspected = [name for name in rig.names if f"'{name}'" in text]
        write_picture(folder / "rig.png", draw_rig(rig, some, suspected))
        if hands is not None and footage is not None:
            _draw_frames(rig, hands, joints, footage, folder)
    with whole_file(folder / "report.json") as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")
    return report


def _pairs(rig: Rig, hands: Array) -> dict[str, float]:
    """Return the median distance from each other's epipolar lines of every pair of cameras that is judged."""
    distances = epipolar_distances_px(rig, ideal_keypoints(rig, hands[:_MOST_FRAMES]))
    return {
        f"{rig.names[a]} {rig.names[b]}": round(float(distances[a, b]), 3)
        for a in range(rig.num_views)
        for b in range(a + 1, rig.num_views)
        if np.isfinite(distances[a, b])
    }


def _joints_world(rig: Rig, hands: Array) -> Float[Array, "hand 21 3"]:
    """Return the hands as all cameras place them; NaN = unknown."""
    near, extent = near_rig(rig)
    points, valid = meeting_points(near, ideal_keypoints(rig, hands).reshape(-1, *hands.shape[2:]))
    world = transform_points(invert_rigid(rig.T_cam_from_world[0]), extent * points)
    return np.where(valid[..., None], world, np.nan)


def _draw_frames(rig: Rig, hands: Array, joints: Array, footage: _Footage, folder: Path) -> None:
    """Draw the key points of a few frames that have images, and where all cameras place them."""
    pictured = [i for i, frame in enumerate(footage.images) if any(frame.images)]
    chosen = np.unique(np.linspace(0, len(pictured) - 1, min(len(pictured), _PICTURED_FRAMES)).astype(int))
    by_frame = joints.reshape(*hands.shape[:2], *joints.shape[1:])
    for index in (pictured[i] for i in chosen):
        for view, image in enumerate(read_views(footage.images[index].images, rig)):
            if isinstance(image, FileNotFoundError | ValueError):
                raise image
            if image is None:
                continue
            together = np.stack([project_raw(rig, view, hand)[0] for hand in by_frame[index]])
            off = np.linalg.norm(together - hands[index, :, view], axis=-1)
            known = off[np.isfinite(off)]
            told = f"{np.median(known):.1f} px from where all cameras place them" if known.size else "no hand"
            picture = draw_keypoints(image, hands[index, :, view], together, f"{rig.names[view]}: {told}")
            write_picture(folder / f"{footage.names[index]}_{rig.names[view]}.jpg", picture)
