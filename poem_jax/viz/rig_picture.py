"""Pictures of a calibration: the rig from above and from the side, and key points against where the cameras
place them together.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid, transform_points, unit_vectors
from poem_jax.hand.topology import BONES
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float, UInt8

PANEL_PX = 620
_MARGIN_PX = 60
_FRUSTUM_SHARE = 0.16
"""Of the rig's extent: the length of a camera's frustum."""
_PAPER, _INK = (255, 255, 255), (40, 40, 40)
_CAMERA_RGB = ((31, 119, 180), (214, 90, 20), (44, 140, 44), (180, 40, 40), (130, 90, 170), (120, 80, 60))
_HAND_RGB = (120, 120, 120)
_KEYPOINT_RGB, _ELSEWHERE_RGB = (60, 220, 90), (255, 60, 60)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SUBPIXEL_BITS = 4


def draw_rig(
    rig: Rig, joints_world: Float[Array, "hand 21 3"], suspected: Sequence[str] = ()
) -> UInt8[Array, "h w 3"]:
    """Draw cameras and hands from above (left) and from the side (right), both to one scale.

    Args:
        rig: The cameras.
        joints_world: Hands, NaN = unknown; may be none.
        suspected: Names of cameras that are drawn with a thick line.

    Returns: RGB. Up is where the cameras' images have their top, on average.
    """
    axes = _axes(rig)
    frusta = _frusta(rig)
    hands = joints_world[np.isfinite(joints_world).all((-1, -2))]
    shown = np.concatenate([frusta.reshape(-1, 3), hands.reshape(-1, 3)]) @ axes.T
    centre = (shown.max(0) + shown.min(0)) / 2
    scale = (PANEL_PX - 2 * _MARGIN_PX) / max(float((shown.max(0) - shown.min(0)).max()), 1e-9)
    panels = []
    for title, (across, down) in (("from above", (0, 1)), ("from the side", (0, 2))):
        panel = np.full((PANEL_PX, PANEL_PX, 3), _PAPER, np.uint8)

        def place(points: Array, across: int = across, down: int = down) -> Array:
            local = points @ axes.T - centre
            return local[..., [across, down]] * scale + PANEL_PX / 2

        for hand in hands:
            for a, b in BONES:
                _line(panel, place(hand[a]), place(hand[b]), _HAND_RGB, 1)
        for view, name in enumerate(rig.names):
            rgb = _CAMERA_RGB[view % len(_CAMERA_RGB)]
            _draw_frustum(panel, place(frusta[view]), name, rgb, 3 if name in suspected else 1)
        _text(panel, title, (12, 24), _INK)
        _draw_ruler(panel, scale)
        panels.append(panel)
    return np.concatenate(panels, axis=1)


def draw_keypoints(
    image: UInt8[Array, "h w 3"],
    keypoints_px: Float[Array, "hand 21 2"],
    together_px: Float[Array, "hand 21 2"],
    title: str,
) -> UInt8[Array, "h w 3"]:
    """Return a copy of a raw image with its key points and a line to where all cameras place each joint.

    Args:
        image: RGB.
        keypoints_px: Given in the raw image; NaN = unseen.
        together_px: The triangulated joints in the raw image; NaN = unknown.
        title: Written into the upper left corner.
    """
    drawn = image.copy()
    for points, places in zip(keypoints_px, together_px, strict=True):
        for a, b in BONES:
            _line(drawn, points[a], points[b], _KEYPOINT_RGB, 1)
        for point, place in zip(points, places, strict=True):
            _line(drawn, point, place, _ELSEWHERE_RGB, 2)
            _dot(drawn, point, _KEYPOINT_RGB)
    _text(drawn, title, (12, 28), _PAPER, 0.8)
    return drawn


def write_picture(path: Path, picture: UInt8[Array, "h w 3"]) -> Path:
    """Write RGB as PNG or JPEG, by the path's ending, whole or not at all."""
    ok, data = cv2.imencode(path.suffix, np.ascontiguousarray(picture[..., ::-1]))
    if not ok:
        raise OSError(f"cannot encode {path}")
    with whole_file(path) as temporary:
        temporary.write_bytes(data.tobytes())
    return path


def _axes(rig: Rig) -> Float[Array, "3 3"]:
    """Return right, towards the viewer's feet and down of the picture as rows, in the world."""
    R = np.asarray(rig.T_cam_from_world, np.float64)[:, :3, :3]
    down = R[:, 1].mean(0)
    down = unit_vectors(down) if np.linalg.norm(down) > 0.1 else R[0, 1]
    right = R[0, 0] - (R[0, 0] @ down) * down
    right = unit_vectors(right) if np.linalg.norm(right) > 0.1 else unit_vectors(np.cross(down, R[0, 2]))
    return np.stack([right, np.cross(down, right), down])


def _frusta(rig: Rig) -> Float[Array, "view 5 3"]:
    """Return each camera's centre and the four corners of its image before it."""
    T_world_from_cam = invert_rigid(np.asarray(rig.T_cam_from_world, np.float64))
    centres = T_world_from_cam[:, :3, 3]
    extent = max(float(np.linalg.norm(centres - centres.mean(0), axis=-1).max()), 1e-6)
    frusta = []
    for K, (width, height), T in zip(rig.K, rig.size_wh, T_world_from_cam, strict=True):
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
        rays = np.concatenate([(corners - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones((4, 1))], -1)
        local = np.concatenate([np.zeros((1, 3)), _FRUSTUM_SHARE * extent * rays])
        frusta.append(transform_points(T, local))
    return np.stack(frusta)


def _draw_frustum(
    panel: Array, corners_px: Float[Array, "5 2"], name: str, rgb: tuple[int, int, int], width: int
) -> None:
    for i in range(1, 5):
        _line(panel, corners_px[0], corners_px[i], rgb, width)
        _line(panel, corners_px[i], corners_px[i % 4 + 1], rgb, width)
    # The top of the image, twice as thick.
    _line(panel, corners_px[1], corners_px[2], rgb, width + 2)
    _text(panel, name, tuple(np.rint(corners_px[0] + [6, -6]).astype(int)), rgb)


def _draw_ruler(panel: Array, pixels_per_m: float) -> None:
    """Draw a length of 1, 2 or 5 times a power of ten that is about a fifth of the panel."""
    wanted = PANEL_PX / 5 / pixels_per_m
    power = 10.0 ** np.floor(np.log10(wanted))
    length = max(step * power for step in (1, 2, 5) if step * power <= wanted)
    start = np.array([12.0, PANEL_PX - 16.0])
    _line(panel, start, start + np.array([length * pixels_per_m, 0]), _INK, 2)
    _text(panel, f"{length:g} m", (12, PANEL_PX - 24), _INK)


def _line(image: Array, a: Array, b: Array, rgb: tuple[int, int, int], width: int) -> None:
    if np.isfinite(a).all() and np.isfinite(b).all():
        cv2.line(image, _fixed(a), _fixed(b), rgb, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def _dot(image: Array, point: Array, rgb: tuple[int, int, int]) -> None:
    if np.isfinite(point).all():
        cv2.circle(image, _fixed(point), 3 << _SUBPIXEL_BITS, rgb, -1, cv2.LINE_AA, _SUBPIXEL_BITS)


def _fixed(point: Array) -> tuple[int, int]:
    """Return a point of [0, W] x [0, H] as OpenCV counts, in parts of a pixel."""
    x, y = np.rint((np.clip(point, -1e5, 1e5) - 0.5) * (1 << _SUBPIXEL_BITS)).astype(int)
    return int(x), int(y)


def _text(image: Array, text: str, place: tuple, rgb: tuple[int, int, int], size: float = 0.5) -> None:
    x, y = int(place[0]), int(place[1])
    x = min(max(x, 2), max(2, image.shape[1] - 9 * len(text)))
    cv2.putText(image, text, (x, min(max(y, 14), image.shape[0] - 4)), _FONT, size, rgb, 1, cv2.LINE_AA)
