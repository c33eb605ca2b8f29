"""Pictures of what goes into a run and what comes out, as files."""

from pathlib import Path

import cv2
import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Num, UInt8


def image_grid(views: Num[Array, "batch view h w 3"], rows: int = 4) -> UInt8[Array, "gh gw 3"]:
    """Lay out the first samples as rows and their views as columns; RGB."""
    pixels = np.asarray(views)[:rows]
    if pixels.dtype != np.uint8:
        # A picture of what is not finite has black there.
        pixels = np.clip(np.nan_to_num(255.0 * pixels, nan=0.0), 0, 255).astype(np.uint8)
    return np.concatenate([np.concatenate(list(sample), axis=1) for sample in pixels], axis=0)


def write_png(path: Path, picture: UInt8[Array, "h w 3"]) -> None:
    """Write an RGB picture as PNG, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not ok:
        raise OSError(f"cannot encode {path} as PNG")
    with whole_file(path) as temporary:
        temporary.write_bytes(data.tobytes())
