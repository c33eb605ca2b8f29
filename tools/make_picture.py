"""Make README's moving picture from a finished demo: `python tools/make_picture.py out/demo docs/demo.webp`.

Left: the four videos, with the hands that `make demo` found drawn over them left of a line that sweeps to
and fro. Right: the same hands in space, seen by a camera that goes round them, with the desk as a grid.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.capture.demo import demo_folder
from poem_jax.data.lens import project_raw
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import unit_vectors
from poem_jax.hand.template import default_hand
from poem_jax.render.zbuffer import NO_FACE, rasterise
from poem_jax.synthetic.desk.cameras import FRAMES_PER_SECOND, desk_rig
from poem_jax.synthetic.shading import vertex_normals
from poem_jax.viz.overlay import MeshInView, draw_overlay
from poem_jax.viz.page import HAND_RGB

TILE_WH = (264, 198)
SPACE_WH = (400, 2 * TILE_WH[1] + 4)
GAP = 4
BACKGROUND = (22, 24, 28)
QUALITY = 82
_FOCAL_PX, _DISTANCE_M = 2.0 * SPACE_WH[1], 1.15
_AIM = np.array([0.0, 0.02, 0.155])
_SWING_DEG, _ELEVATION_DEG = 38.0, 20.0
_LIGHT = unit_vectors(np.array([0.5, -0.7, -0.6]))
"""In the frame of the camera that goes round."""


class Found(NamedTuple):
    """The demo's result."""

    sides: tuple[str, ...]
    vertices_world: np.ndarray
    """(frame, hand, 778, 3); NaN = not found."""


def read_found(folder: Path) -> Found:
    """Read `prediction.npz`."""
    with np.load(folder / "prediction.npz") as stored:
        return Found(tuple(map(str, stored["hand_side"])), stored["vertices_world"])


def read_video(path: Path) -> list[np.ndarray]:
    """Return all frames, RGB."""
    video, frames = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        frames.append(np.ascontiguousarray(read[1][..., ::-1]))
    return frames


def tile(rig: Rig, view: int, image: np.ndarray, found: Found, frame: int, swept: float) -> np.ndarray:
    """Return a video's frame with the hands drawn on its left part."""
    meshes = []
    for side, vertices in zip(found.sides, found.vertices_world[frame], strict=True):
        if np.isfinite(vertices).all():
            pixels, points_cam = project_raw(rig, view, vertices)
            meshes.append(MeshInView(pixels, points_cam, default_hand(side).faces, HAND_RGB[side]))
    drawn = draw_overlay(image, meshes, opacity=0.85)
    column = int(swept * image.shape[1])
    drawn[:, column:] = image[:, column:]
    cv2.line(drawn, (column, 0), (column, image.shape[0]), (245, 245, 245), 2)
    small = cv2.resize(drawn, TILE_WH, interpolation=cv2.INTER_AREA)
    return small


def in_space(rig: Rig, found: Found, frame: int, phase: float) -> np.ndarray:
    """Draw the hands as the camera that goes round sees them."""
    azimuth = np.radians(_SWING_DEG) * np.sin(2 * np.pi * phase)
    elevation = np.radians(_ELEVATION_DEG)
    back = np.array(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    right = unit_vectors(np.cross(-back, [0.0, 0.0, 1.0]))
    R = np.stack([right, np.cross(-back, right), -back])
    scale = 2
    width, height = (scale * side for side in SPACE_WH)
    image = np.full((height, width, 3), BACKGROUND, np.uint8)

    def seen(points: np.ndarray) -> np.ndarray:
        cam = (points - _AIM) @ R.T + [0, 0, _DISTANCE_M]
        focal = scale * _FOCAL_PX
        depth = np.maximum(cam[:, 2], 0.05)
        return np.column_stack(
            [focal * cam[:, 0] / depth + width / 2, focal * cam[:, 1] / depth + height / 2, depth]
        )

    def lines(paths: np.ndarray, color: tuple[int, int, int]) -> None:
        for path in paths:
            ends = np.round(8 * seen(path)[:, :2]).astype(np.int32)
            cv2.polylines(image, [ends], False, color, 1, cv2.LINE_AA, shift=3)

    place = np.linspace(-0.2, 0.2, 9)
    lines(np.array([[[x, -0.2, 0], [x, 0.2, 0]] for x in place]), (58, 62, 70))
    lines(np.array([[[-0.2, y, 0], [0.2, y, 0]] for y in place]), (58, 62, 70))
    for side, vertices in zip(found.sides, found.vertices_world[frame], strict=True):
        if np.isfinite(vertices).all():
            shade = vertices * [1, 1, 0]
            faces = np.round(8 * seen(shade)[:, :2]).astype(np.int32)[default_hand(side).faces]
            for face in faces:
                cv2.fillConvexPoly(image, face, (14, 15, 18), shift=3)
    draw_meshes(image, found, frame, seen, R)
    return cv2.resize(image, SPACE_WH, interpolation=cv2.INTER_AREA)


def draw_meshes(image: np.ndarray, found: Found, frame: int, seen, R: np.ndarray) -> None:
    """Draw both hands with smooth shading into the picture."""
    vertices, faces, normals, colors, first = [], [], [], [], 0
    for side, hand in zip(found.sides, found.vertices_world[frame].astype(float), strict=True):
        if not np.isfinite(hand).all():
            continue
        own = np.ascontiguousarray(default_hand(side).faces, np.int32)
        normal = np.empty_like(hand)
        vertex_normals(hand, own, normal)
        vertices.append(hand)
        faces.append(own + first)
        normals.append(normal @ R.T)
        colors.append(np.tile(HAND_RGB[side], (len(hand), 1)))
        first += len(hand)
    if not vertices:
        return
    corners = np.concatenate(faces)
    raster = rasterise(seen(np.concatenate(vertices)), corners, image.shape[:2])
    covered = raster.face_index != NO_FACE
    at, weights = corners[raster.face_index[covered]], raster.barycentric[covered]
    normal = unit_vectors(np.einsum("pk,pkc->pc", weights, np.concatenate(normals)[at]))
    color = np.einsum("pk,pkc->pc", weights, np.concatenate(colors)[at].astype(float)) / 255
    light = 0.30 + 0.62 * np.clip((normal @ _LIGHT + 0.25) / 1.25, 0, 1) + 0.18 * np.clip(-normal[:, 1], 0, 1)
    half = unit_vectors(_LIGHT + np.array([0, 0, -1.0]))
    glint = 0.22 * np.clip(normal @ half, 0, 1) ** 24
    edge = 0.18 * (1 - np.clip(-normal[:, 2], 0, 1)) ** 3
    shaded = np.clip(color * light[:, None] + glint[:, None] + edge[:, None], 0, 1)
    image[covered] = np.round(255 * shaded)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("demo", type=Path, help="folder that `make demo` wrote")
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args()
    rig, found = desk_rig(), read_found(arguments.demo)
    videos = [read_video(demo_folder() / f"{name}.mp4") for name in rig.names]
    count, frames = len(found.vertices_world), []
    for frame in range(count):
        phase = frame / count
        swept = 0.5 - 0.9 * np.cos(2 * np.pi * phase)
        tiles = [
            tile(rig, v, video[frame], found, frame, np.clip(swept, 0, 1)) for v, video in enumerate(videos)
        ]
        rows = [join(tiles[:2], axis=1), join(tiles[2:], axis=1)]
        whole = join([join(rows, axis=0), in_space(rig, found, frame, phase)], axis=1)
        frames.append(np.ascontiguousarray(whole[..., ::-1]))
    animation = cv2.Animation()
    animation.frames, animation.durations = frames, [round(1000 / FRAMES_PER_SECOND)] * count
    cv2.imwriteanimation(str(arguments.picture), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    megabytes = arguments.picture.stat().st_size / 1e6
    print(f"{arguments.picture}: {megabytes:.2f} MB, {frames[0].shape[1::-1]} pixels")


def join(pictures: list[np.ndarray], axis: int) -> np.ndarray:
    """Put pictures side by side (axis 1) or below each other (axis 0) with a gap."""
    size = list(pictures[0].shape)
    size[axis] = GAP
    gap = np.full(size, BACKGROUND, np.uint8)
    parts = [pictures[0]]
    for picture in pictures[1:]:
        parts += [gap, picture]
    return np.concatenate(parts, axis=axis)


if __name__ == "__main__":
    main()
