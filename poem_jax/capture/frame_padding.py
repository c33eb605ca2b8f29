"""Takes of similar length share compiled programs: they are padded with frames in which nothing is seen."""

import numpy as np

from poem_jax.typing import Array, Float

_FRAMES_TOGETHER = 128


def padded_frames(array: Float[Array, "frame *rest"]) -> Float[Array, "more *rest"]:
    """Add frames of NaN up to the next power of two, beyond 128 frames to the next multiple of 128."""
    frames = len(array)
    many = -(-frames // _FRAMES_TOGETHER) * _FRAMES_TOGETHER
    padded = many if frames > _FRAMES_TOGETHER else 2 ** int(np.ceil(np.log2(frames)))
    return np.concatenate([array, np.full((padded - frames, *array.shape[1:]), np.nan)])
