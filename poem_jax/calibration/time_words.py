"""What is said of cameras that took their frames earlier or later than the others."""

import numpy as np

from poem_jax.calibration.findings import Finding
from poem_jax.calibration.time_offsets import TimeOffsets, find_offsets, frame_step_s
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float

TIME_OFFSET = "time offset"
"""Name of the finding."""
LATE_FRAMES = 0.2
"""Smaller offsets are not told from none."""

_REMAINS = 0.7
"""So much of the distances, at most, may remain where offsets are named that the noise would hide."""
_NOISE_PX = 0.5


def judge_time(
    rig: Rig,
    keypoints_px: Float[Array, "frame hand view joint 2"],
    time_s: Float[Array, " frame"] | None = None,
) -> list[Finding]:
    """Name cameras that took their frames earlier or later, though the views agree within their noise.

    Args:
        rig: The cameras.
        keypoints_px: In pixels of the raw images, frames in the order of time; NaN = unseen.
        time_s: When each frame was taken, seconds; None = the frames are evenly spaced.

    Returns: At most one finding, `time offset`.
    """
    offsets = find_offsets(rig, keypoints_px, time_s)
    if offsets is None or np.abs(offsets.frames).max() < LATE_FRAMES:
        return []
    if offsets.error_px > _REMAINS * offsets.given_px or offsets.given_px < _NOISE_PX:
        return []
    return [late_cameras(rig, offsets, time_s)]


def late_cameras(rig: Rig, offsets: TimeOffsets, time_s: Float[Array, " frame"] | None) -> Finding:
    """Return the finding that names the cameras which are off, by how much, and what it explains."""
    step_s = None if time_s is None else frame_step_s(time_s)
    moments, seconds_late = [], []
    for name, frames in zip(rig.names, offsets.frames, strict=True):
        if abs(frames) >= LATE_FRAMES:
            seconds = "" if step_s is None else f" ({1000 * frames * step_s:+.0f} ms)"
            moments.append(f"'{name}' {frames:+.2f} frames{seconds}")
            seconds_late.append(f"{name}={0 if step_s is None else frames * step_s:.4f}")
    return Finding(
        TIME_OFFSET,
        f"the cameras' frames are not of one moment: {', '.join(moments)} after the others' frames of the "
        f"same number (minus: before); so the key points lie {offsets.error_px:.1f} px off each other's "
        f"epipolar lines, as given {offsets.given_px:.1f} px (worst pair, median)",
        "shift these cameras' frames by as much, or record with cameras that are triggered together"
        if step_s is None
        else f"add --offsets {','.join(seconds_late)} to those in use (or to sync.json), and search the "
        "videos anew",
        fatal=False,
    )
