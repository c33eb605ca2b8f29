"""Groups of frames of one size, so that takes of any length share compiled programs."""

import numpy as np

from poem_jax.capture.frame_times import SECONDS_PER_FRAME
from poem_jax.typing import Array, Float

FRAMES_TOGETHER = 64
"""Frames that are fitted at a time: enough to know a hand's shape, few enough to see results soon."""


def padded_frames(
    array: Float[Array, "frame *rest"], together: int = FRAMES_TOGETHER
) -> Float[Array, "more *rest"]:
    """Add frames of NaN, in which nothing is seen, up to the next multiple of `together`."""
    missing = -len(array) % together
    return np.concatenate([array, np.full((missing, *array.shape[1:]), np.nan)])


def padded_times(time_s: Float[Array, " frame"], together: int = FRAMES_TOGETHER) -> Float[Array, " more"]:
    """Let moments go on as far as `padded_frames` does, at the rate of video, seconds."""
    missing = -len(time_s) % together
    return np.concatenate([time_s, time_s[-1] + SECONDS_PER_FRAME * np.arange(1, 1 + missing)])
