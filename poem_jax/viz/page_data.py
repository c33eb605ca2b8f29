"""What a page holds of a take, in JSON: names and numbers as they are, arrays as whole numbers of 16 bits.

An array's entry is `offset + step * number`, or unknown where the number is `_UNKNOWN`.
"""

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from poem_jax.hand.topology import BONES, JOINT_NAMES, NUM_JOINTS
from poem_jax.typing import Array, Float, Int
from poem_jax.viz.first_view import View
from poem_jax.viz.page_content import HAND_RGB, Caption, PageCamera, PageFrame

_UNKNOWN = -(2**15)
_LARGEST = 2**15 - 1
_KEYPOINT_STEP_PX = 1 / 8
_ERROR_STEP_PX = 0.02
_SIGMA_STEP_M = 1e-5
_CONFIDENCE_STEP = 1e-3


def page_data(
    frames: Sequence[PageFrame],
    cameras: Sequence[PageCamera],
    faces: Mapping[str, Int[Array, "face 3"]],
    caption: Caption,
    joint_weights: Float[Array, "vert 21"] | None,
    view: View,
) -> dict[str, Any]:
    """Return the page's data in plain types; see `write_page` for the arguments."""
    names = list(dict.fromkeys(name for frame in frames for name in frame.hands))
    return {
        "title": caption.title,
        "subtitle": caption.subtitle,
        "facts": list(caption.facts.items()),
        "view": {
            "position": _plain(view.position),
            "look_at": _plain(view.look_at),
            "up": _plain(view.up),
            "fov": view.fov,
        },
        "cameras": [
            {
                "name": camera.name,
                "T_cam_from_world": _plain(camera.T_cam_from_world),
                "focal_px": float(camera.focal_px),
                "hw": list(camera.hw),
            }
            for camera in cameras
        ],
        "hands": [{"name": name, "side": _side(name), "rgb": HAND_RGB[_side(name)]} for name in names],
        "frames": [frame.name for frame in frames],
        "times_s": _times(frames),
        "bridged": [
            [name in frame.hands and frame.hands[name].bridged for name in names] for frame in frames
        ],
        "pictures": [[None if jpeg is None else _text(jpeg) for jpeg in frame.pictures] for frame in frames],
        "arrays": _arrays(frames, names, len(cameras)),
        "faces": {side: _text(np.asarray(faces[side], "<u2").tobytes()) for side in faces},
        "joint_weights": None if joint_weights is None else _weights(joint_weights),
        "joints": list(JOINT_NAMES),
        "bones": BONES,
    }


def _side(name: str) -> str:
    return "left" if name.startswith("left") else "right"


def _plain(array: Float[Array, "..."]) -> list[Any]:
    return np.asarray(array, float).tolist()


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _times(frames: Sequence[PageFrame]) -> list[float] | None:
    """Return the frames' times if all are known and go forward."""
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    if len(times) < len(frames) or not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        return None
    return [round(float(time), 6) for time in times]


def _arrays(frames: Sequence[PageFrame], names: Sequence[str], views: int) -> dict[str, Any]:
    """Return the arrays (frame, hand, ...) of all hands; None for those that no hand has."""
    vertices = next((len(hand.vertices_world) for frame in frames for hand in frame.hands.values()), 0)
    points = {"vertices_world": (vertices, 3), "joints_world": (NUM_JOINTS, 3)}
    steps = {
        "keypoints_px": ((views, NUM_JOINTS, 2), _KEYPOINT_STEP_PX),
        "error_px": ((views, NUM_JOINTS), _ERROR_STEP_PX),
        "sigma_m": ((NUM_JOINTS,), _SIGMA_STEP_M),
        "confidence": ((views, NUM_JOINTS), _CONFIDENCE_STEP),
    }
    stored = {}
    for field, shape in points.items():
        array = _gathered(frames, names, field, shape)
        stored[field] = None if array is None else _stored(array, *_range(array))
    for field, (shape, step) in steps.items():
        array = _gathered(frames, names, field, shape)
        stored[field] = None if array is None else _stored(array, 0.0, step)
    return stored


def _gathered(
    frames: Sequence[PageFrame], names: Sequence[str], field: str, shape: tuple[int, ...]
) -> Float[Array, "frame hand *shape"] | None:
    array = np.full((len(frames), len(names), *shape), np.nan, np.float32)
    known = False
    for index, frame in enumerate(frames):
        for name, hand in frame.hands.items():
            value = getattr(hand, field)
            if value is not None:
                array[index, names.index(name)], known = value, True
    return array if known else None


def _range(array: Float[Array, "..."]) -> tuple[float, float]:
    """Return the offset and step with which an array just fits."""
    low, high = float(np.nanmin(array)), float(np.nanmax(array))
    return (low + high) / 2, max((high - low) / (2 * _LARGEST), 1e-9)


def _stored(array: Float[Array, "..."], offset: float, step: float) -> dict[str, Any]:
    """Round an array to whole steps; what lies beyond 16 bits goes to their end."""
    numbers = np.clip(np.rint((array - offset) / step), _UNKNOWN + 1, _LARGEST)
    whole = np.where(np.isfinite(array), numbers, _UNKNOWN).astype("<i2")
    return {"shape": list(array.shape), "offset": offset, "step": step, "numbers": _text(whole.tobytes())}


def _weights(joint_weights: Float[Array, "vert 21"]) -> str:
    return _text(np.clip(np.rint(255 * np.asarray(joint_weights)), 0, 255).astype(np.uint8).tobytes())
