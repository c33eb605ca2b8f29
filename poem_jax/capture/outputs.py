"""What a reconstruction leaves on disk. Every file appears whole or not at all."""

import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from poem_jax.capture.lens import PictureMap, picture_map, project_raw, take_picture
from poem_jax.capture.take import FrameOutcome, Take
from poem_jax.geometry.distortion import undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.io.atomic import whole_file
from poem_jax.io.meshes import write_mesh
from poem_jax.typing import Array, Float, Int, UInt8
from poem_jax.viz.overlay import MeshInView, draw_overlay
from poem_jax.viz.page import HAND_RGB, PageCamera, PageFrame

MESH_SUFFIXES = (".glb", ".obj")
PAGE_FRAMES = 120
"""A take with more frames that hold a hand is thinned out evenly for the page."""
_LONG_TAKE = 20
_PAGE_PICTURE_PX = 320
_PAGE_PICTURE_PX_OF_LONG_TAKES = 200


def write_frame(
    folder: Path,
    take: Take,
    outcome: FrameOutcome,
    images: Sequence[UInt8[Array, "h w 3"] | None],
    faces: Mapping[str, Int[Array, "face 3"]],
) -> list[Path]:
    """Write the meshes of a frame (`<hand>.glb`, `<hand>.obj`) and `overlay_<camera>.png` for every image."""
    written = []
    shown = []
    for name, side, hand in zip(take.hand_names, take.hands.hand_side, outcome.hands, strict=True):
        if hand.result is None:
            continue
        vertices = hand.result.vertices_world
        shown.append((vertices, faces[side], HAND_RGB[side]))
        written += [write_mesh(folder / f"{name}{suffix}", vertices, faces[side]) for suffix in MESH_SUFFIXES]
    for view, image in enumerate(images):
        if image is not None:
            meshes = [_in_view(take.rig, view, *mesh) for mesh in shown]
            path = folder / f"overlay_{take.rig.names[view]}.png"
            written.append(write_png(path, draw_overlay(image, meshes)))
    return written


def write_png(path: Path, image: UInt8[Array, "h w 3"]) -> Path:
    """Write an RGB image."""
    with whole_file(path) as temporary:
        ok, data = cv2.imencode(".png", image[..., ::-1])
        if not ok:
            raise OSError(f"cannot encode {path} as PNG")
        temporary.write_bytes(data.tobytes())
    return path


def write_arrays(path: Path, arrays: Mapping[str, Array]) -> Path:
    """Write an npz."""
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
    return path


def write_json(path: Path, content: Any) -> Path:
    """Write JSON; NaN becomes null, so that every parser reads it."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(_plain(content), indent=1, allow_nan=False), encoding="utf-8")
    return path


def frame_report(take: Take, frame: int, outcome: FrameOutcome) -> dict[str, Any]:
    """Say in plain types what came of a frame."""
    report: dict[str, Any] = {"frame": take.frames[frame].name}
    if outcome.problems:
        report["image_problems"] = [str(problem.error) for problem in outcome.problems]
    hands = []
    for hand_name, hand in zip(take.hand_names, outcome.hands, strict=True):
        used = [camera for camera, seen in zip(take.rig.names, hand.view_mask, strict=True) if seen]
        entry: dict[str, Any] = {"hand": hand_name, "valid": hand.result is not None, "views_used": used}
        if hand.result is None:
            entry["reason"] = hand.reason
        else:
            entry["reprojection_px"] = _by_camera(take.rig, hand.reprojection_px)
            entry["joints_shown"] = _by_camera(take.rig, hand.joints_shown)
            if hand.result.joint_sigma_m is not None:
                entry["joint_sigma_mm"] = (1000 * hand.result.joint_sigma_m).astype(float).round(2).tolist()
        hands.append(entry)
    return {**report, "hands": hands}


def remove_stale_meshes(out: Path, take: Take, outcomes: Sequence[FrameOutcome]) -> None:
    """Remove the meshes that an earlier run left of the hands that this one did not reconstruct."""
    for frame, outcome in zip(take.frames, outcomes, strict=True):
        for name, hand in zip(take.hand_names, outcome.hands, strict=True):
            for suffix in MESH_SUFFIXES if hand.result is None else ():
                (out / frame.name / f"{name}{suffix}").unlink(missing_ok=True)


def _by_camera(rig: Rig, values: Float[Array, " view"]) -> dict[str, float]:
    pairs = zip(rig.names, values, strict=True)
    return {camera: float(value) for camera, value in pairs if np.isfinite(value)}


def versions() -> dict[str, str]:
    """Return the versions that matter for repeating a run."""
    import flax
    import jax

    import poem_jax

    return {
        "poem_jax": poem_jax.__version__,
        "jax": jax.__version__,
        "flax": flax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
    }


class Gallery(NamedTuple):
    """The small ideal cameras whose pictures the page shows at the places of a rig's cameras."""

    cameras: list[PageCamera]
    maps: list[PictureMap]


def make_gallery(rig: Rig, num_frames: int = 1) -> Gallery:
    """Prepare the page's pictures; those of a long take are smaller."""
    longer = _PAGE_PICTURE_PX if num_frames <= _LONG_TAKE else _PAGE_PICTURE_PX_OF_LONG_TAKES
    pairs = [_page_camera(rig, view, longer) for view in range(rig.num_views)]
    return Gallery([camera for camera, _ in pairs], [where for _, where in pairs])


class PageFrames:
    """The frames of a page, gathered while a take goes by: those with a hand, thinned out evenly."""

    def __init__(self) -> None:
        self.kept: list[PageFrame] = []
        self._every = 1
        self._offered = 0

    def offer(self, make: Callable[[], PageFrame]) -> None:
        """Count a frame that holds a hand; make and keep it if its turn has come."""
        if self._offered % self._every == 0:
            self.kept.append(make())
        self._offered += 1
        if len(self.kept) > PAGE_FRAMES:
            self.kept = self.kept[::2]
            self._every *= 2


def page_frame(
    take: Take, outcome: FrameOutcome, name: str, images: Sequence[Array | None], gallery: Gallery
) -> PageFrame:
    """Make a frame of the page: the hands, and small undistorted pictures."""
    hands = {
        hand_name: hand.result.vertices_world
        for hand_name, hand in zip(take.hand_names, outcome.hands, strict=True)
        if hand.result is not None
    }
    views = zip(images, gallery.maps, strict=True)
    return PageFrame(name, hands, [None if image is None else take_picture(image, at) for image, at in views])


def _page_camera(rig: Rig, view: int, longer: int) -> tuple[PageCamera, PictureMap]:
    """Make a pinhole with a central axis that looks at the middle of a photograph, whose own axis may not."""
    K, dist = rig.K[view], rig.dist[view]
    width, height = (int(size) for size in rig.size_wh[view])
    x, y = undistort_pixels(np.array([[width / 2, height / 2]]), K, dist)[0]
    ray = np.array([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], 1.0])
    R_cam_from_picture = rotation_from_axis_angle(_turn_to(ray))
    scale = longer / max(width, height)
    # Off its axis an image is stretched by the squared length of the ray.
    focal_px = float(scale * (K[0, 0] + K[1, 1]) / 2 * (ray @ ray))
    hw = (round(scale * height), round(scale * width))
    K_picture = np.array([[focal_px, 0, hw[1] / 2], [0, focal_px, hw[0] / 2], [0, 0, 1]])
    T_picture_from_world = rigid(R_cam_from_picture.T, np.zeros(3)) @ rig.T_cam_from_world[view]
    where = picture_map(K, dist, K_picture, hw, 1 / scale, R_cam_from_picture)
    return PageCamera(rig.names[view], T_picture_from_world, focal_px, hw), where


def _turn_to(ray: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the axis-angle that turns the z axis to a ray."""
    axis = np.cross([0.0, 0.0, 1.0], ray)
    sine = np.linalg.norm(axis)
    return axis / max(float(sine), 1e-12) * np.arctan2(sine, ray[2])


def _in_view(
    rig: Rig, view: int, vertices_world: Array, faces: Array, rgb: tuple[int, int, int]
) -> MeshInView:
    vertices_px, vertices_cam = project_raw(rig, view, vertices_world)
    return MeshInView(vertices_px, vertices_cam, faces, rgb)


def _plain(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_plain(value) for value in content]
    if isinstance(content, float | np.floating):
        return float(content) if np.isfinite(content) else None
    return str(content) if isinstance(content, os.PathLike) else content
