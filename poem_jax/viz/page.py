"""One self-contained HTML page per reconstruction: hands, cameras with their pictures, numbers, and a player.

The page opens from disk with no network: data, styles and scripts (`page_client/`) stand in the one file, and
its security policy forbids it to load anything. Frames hold their pictures encoded, so that a page that is
gathered while a take goes by needs little memory.
"""

import json
import os
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float, Int, UInt8
from poem_jax.viz.first_view import View, initial_view
from poem_jax.viz.page_content import HAND_RGB as HAND_RGB
from poem_jax.viz.page_content import Caption, PageCamera, PageFrame
from poem_jax.viz.page_content import PageHand as PageHand
from poem_jax.viz.page_data import page_data

_JPEG_QUALITY = 75
_SCRIPTS = (
    "data",
    "measures",
    "geometry",
    "pictures",
    "scene",
    "marks",
    "panel",
    "cameras",
    "player",
    "main",
)
"""Files of `page_client/`, in the order in which they need each other."""


def encode_picture(image: UInt8[Array, "h w 3"]) -> bytes:
    """Return an RGB picture as a JPEG."""
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes()


def write_page(
    path: str | os.PathLike,
    frames: Sequence[PageFrame],
    cameras: Sequence[PageCamera],
    faces: Mapping[str, Int[Array, "face 3"]],
    *,
    caption: Caption | None = None,
    joint_weights: Float[Array, "vert 21"] | None = None,
    view: View | None = None,
) -> Path:
    """Write the page; the file appears whole or not at all.

    Args:
        path: The HTML file.
        frames: The take in order, at least one.
        cameras: The cameras of every frame's `pictures`.
        faces: Triangles by side, 'right' and 'left', counter-clockwise seen from outside.
        caption: Title and numbers; None = the file's folder is the title.
        joint_weights: How much each joint says about each vertex, from 0; rows sum to 1. With them the meshes
            can be coloured by the joints' numbers.
        view: First view; None = `initial_view` of the first frame with a hand.

    Raises:
        ValueError: No frame, or no hand in any frame and no `view`; or a frame has another number of pictures
            than there are cameras.
    """
    if not frames:
        raise ValueError("a page needs at least one frame; got none")
    for frame in frames:
        if len(frame.pictures) != len(cameras):
            raise ValueError(
                f"frame {frame.name!r} must have one picture, or None, for each of {len(cameras)} cameras; "
                f"got {len(frame.pictures)}"
            )
    if view is None:
        view = initial_view(_first_points(frames), np.stack([camera.T_cam_from_world for camera in cameras]))
    caption = Caption(Path(path).absolute().parent.name) if caption is None else caption
    html = _filled(page_data(frames, cameras, faces, caption, joint_weights, view), caption.title)
    with whole_file(path) as temporary:
        temporary.write_text(html, encoding="utf-8")
    return Path(path)


def _filled(data: Mapping[str, object], title: str) -> str:
    """Put title, style, data and scripts into the page's frame."""
    client = files("poem_jax.viz") / "page_client"
    # In a script no "</" may come that is not its end.
    content = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "TITLE": escape(title),
        "STYLE": (client / "page.css").read_text(encoding="utf-8"),
        "DATA": content,
        "SCRIPTS": "\n".join(
            f"<script>\n{(client / f'{name}.js').read_text(encoding='utf-8')}</script>" for name in _SCRIPTS
        ),
    }
    pieces = (client / "page.html").read_text(encoding="utf-8").split("@@")
    return "".join(piece if index % 2 == 0 else parts[piece] for index, piece in enumerate(pieces))


def _first_points(frames: Sequence[PageFrame]) -> Array:
    for frame in frames:
        if frame.hands:
            return np.concatenate([np.asarray(hand.vertices_world) for hand in frame.hands.values()])
    raise ValueError("no frame holds a hand: pass `view` to say where the page should look")
