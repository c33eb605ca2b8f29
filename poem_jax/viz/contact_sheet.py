"""A contact sheet: samples of a data set by views, with joints and the mesh's outline drawn in each image.

It shows at a glance whether a reader's conventions are right. Two things are drawn that come from different
labels: the *key points*, as stored in pixels, joined to a skeleton, and the *outline* of the mesh, which is
projected with K from each camera's own vertices. Whatever is wrong with a camera, a mirror or a unit makes
one leave the other, or both leave the hand.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from poem_jax.data.frames import EncodedImage, MultiViewFrame
from poem_jax.data.lens import stored_picture_map, take_picture
from poem_jax.data.pictures import decode
from poem_jax.data.transforms import square_box
from poem_jax.geometry.cameras import crop_homography, project_cam, transform_pixels
from poem_jax.hand.topology import BONES, FINGER_JOINTS, WRIST
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Bool, Float, Int, UInt8
from poem_jax.viz.overlay import MeshInView, silhouette

TILE_PX = 256
MAX_VIEWS = 10
"""Views of a sample on the sheet; of more, the first ones."""
AROUND_HAND = 2.2
"""The tile's side over that of the square about hand."""
_LABEL_PX = 18
_OUTLINE_RGB = (255, 255, 255)
_FINGER_RGB = ((255, 80, 80), (255, 190, 40), (90, 220, 90), (70, 170, 255), (210, 110, 255))
"""Thumb to little finger."""
_LETTERS = (cv2.FONT_HERSHEY_SIMPLEX, 0.4, (235, 235, 235), 1, cv2.LINE_AA)
_SUBPIXEL_BITS = 4

_log = logging.getLogger(__name__)


def contact_sheet(
    frames: Sequence[MultiViewFrame],
    *,
    faces: Int[Array, "face 3"] | None = None,
    tile_px: int = TILE_PX,
) -> UInt8[Array, "h w 3"]:
    """Draw a row of views for every sample.

    Args:
        frames: At least one.
        faces: Triangles of the hand model that the vertices belong to; None = the outline is that of discs
            about the vertices, which needs none.
        tile_px: Side of a view.

    Returns: The sheet, RGB. An image that cannot be decoded gives an empty tile that says so, and a warning.
    """
    if not frames:
        raise ValueError("a contact sheet needs at least one sample; got none")
    columns = min(max(len(frame.images) for frame in frames), MAX_VIEWS)
    height = tile_px + 2 * _LABEL_PX
    sheet = np.zeros((len(frames) * height, columns * tile_px, 3), np.uint8)
    for row, frame in enumerate(frames):
        top = row * height
        more = "" if len(frame.images) <= columns else f" ({len(frame.images)} views)"
        _write(sheet, frame.key + more, (4, top + 13))
        for view in range(min(len(frame.images), columns)):
            left = view * tile_px
            tile = _tile(frame, view, faces, tile_px)
            sheet[top + _LABEL_PX : top + _LABEL_PX + tile_px, left : left + tile_px] = tile
            _write(sheet, frame.view_names[view][:30], (left + 4, top + _LABEL_PX + tile_px + 13))
    return sheet


def write_contact_sheet(
    path: Path, frames: Sequence[MultiViewFrame], *, faces: Int[Array, "face 3"] | None = None
) -> Path:
    """Write a contact sheet as PNG; see `contact_sheet`."""
    ok, data = cv2.imencode(".png", contact_sheet(frames, faces=faces)[..., ::-1])
    if not ok:
        raise OSError(f"cannot encode {path} as PNG")
    with whole_file(path) as temporary:
        temporary.write_bytes(data.tobytes())
    return path


def _tile(
    frame: MultiViewFrame, view: int, faces: Int[Array, "face 3"] | None, side: int
) -> UInt8[Array, "h w 3"]:
    """Draw the surroundings of the hand in one view, its lens and mirror taken out."""
    K, size_wh = frame.K[view], frame.size_wh[view]
    box = frame.keypoints_px[view] if frame.box_px is None else frame.box_px[view].reshape(2, 2)
    square = square_box(np.asarray(box, np.float64), AROUND_HAND)
    H_tile_from_image = crop_homography(square, (side, side))
    try:
        image = decode(frame.images[view], (int(size_wh[0]), int(size_wh[1])))
    except ValueError as error:
        _log.warning("sample %s, view %s: %s", frame.key, frame.view_names[view], error)
        return _empty_tile(frame.images[view], side)
    where = stored_picture_map(
        K,
        None if frame.dist is None else frame.dist[view],
        None if frame.mirror_px is None else float(frame.mirror_px[view]),
        H_tile_from_image @ K,
        (side, side),
        float((square[2] - square[0]) / side),
    )
    tile = take_picture(image, where)
    vertices_cam = np.asarray(frame.vertices_cam[view], np.float64)
    vertices = transform_pixels(H_tile_from_image, project_cam(np.asarray(K, np.float64), vertices_cam))
    covered = _covered(vertices, vertices_cam, faces, side)
    contours, _ = cv2.findContours(covered.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(tile, contours, -1, _OUTLINE_RGB, 1)
    _draw_skeleton(
        tile, transform_pixels(H_tile_from_image, np.asarray(frame.keypoints_px[view], np.float64))
    )
    return tile


def _covered(
    vertices_px: Float[Array, "vert 2"],
    vertices_cam: Float[Array, "vert 3"],
    faces: Int[Array, "face 3"] | None,
    side: int,
) -> Bool[Array, "h w"]:
    """Return the pixels of a tile that the hand covers."""
    if faces is not None:
        mesh = MeshInView(vertices_px, vertices_cam, faces, _OUTLINE_RGB)
        return silhouette([mesh], (side, side))
    radius = max(1, side // 32)
    mask = np.zeros((side, side), np.uint8)
    for u, v in vertices_px[np.abs(vertices_px).max(-1) < 4 * side]:
        cv2.circle(mask, (round(u - 0.5), round(v - 0.5)), radius, 1, -1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.erode(mask, disc, borderValue=1).astype(bool)


def _draw_skeleton(tile: UInt8[Array, "h w 3"], joints_px: Float[Array, "21 2"]) -> None:
    """Draw bones and joints into the tile, each finger in its colour."""
    scale = 1 << _SUBPIXEL_BITS
    bounded = np.clip(joints_px, -8 * len(tile), 8 * len(tile))
    places = [tuple(int(c) for c in np.rint((uv - 0.5) * scale)) for uv in bounded]
    colours = {joint: _FINGER_RGB[f] for f, finger in enumerate(FINGER_JOINTS) for joint in finger}
    colours[WRIST] = _OUTLINE_RGB
    for parent, child in BONES:
        cv2.line(tile, places[parent], places[child], colours[child], 1, cv2.LINE_AA, _SUBPIXEL_BITS)
    for joint, place in enumerate(places):
        cv2.circle(tile, place, 2 * scale, colours[joint], -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _empty_tile(image: EncodedImage, side: int) -> UInt8[Array, "h w 3"]:
    tile = np.full((side, side, 3), (60, 20, 20), np.uint8)
    _write(tile, "cannot be decoded:", (6, side // 2))
    _write(tile, image.name[-38:], (6, side // 2 + 16))
    return tile


def _write(picture: UInt8[Array, "h w 3"], text: str, place: tuple[int, int]) -> None:
    cv2.putText(picture, text.encode("ascii", "replace").decode(), place, *_LETTERS)
