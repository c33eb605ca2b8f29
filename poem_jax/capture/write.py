"""The stage `write`: what a reconstruction leaves on disk, written as the frames come.

Every file appears whole or not at all. If the stream ends early, by Ctrl-C or an error, what was done is
written before the exception goes on its way.
"""

import functools
import json
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from poem_jax.capture.frame import Frame
from poem_jax.capture.page_frame import page_facts, page_frame
from poem_jax.capture.report import Clock, Report
from poem_jax.capture.take import Take
from poem_jax.data.lens import PictureMap, picture_map, project_raw
from poem_jax.geometry.distortion import undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import rigid, smallest_rotation
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES, NUM_SKELETON_JOINTS, NUM_VERTICES
from poem_jax.io.animated_glb import AnimatedGlb
from poem_jax.io.atomic import whole_file
from poem_jax.io.file_names import safe_file_name, safe_file_names
from poem_jax.io.growing_npz import GrowingNpz
from poem_jax.io.meshes import is_own_mesh, write_mesh
from poem_jax.typing import Array, Float, Int, UInt8
from poem_jax.viz.overlay import MeshInView, draw_overlay
from poem_jax.viz.page import HAND_RGB, Caption, PageCamera, PageFrame, write_page

MESH_SUFFIXES = (".glb", ".obj")
PREDICTION, REPORT, PAGE, ANIMATION = "prediction.npz", "report.json", "index.html", "hands.glb"
SECONDS_PER_FRAME = 1 / 30
"""Of the animation: what video cameras take; a capture does not say."""
PAGE_FRAMES = 120
"""A take with more frames that hold a hand is thinned out evenly for the page."""
_PAGE_PIXELS = 14e6
"""Of all pictures of a page together: as JPEG they take 2 to 3 MB, in the page 3 to 4."""
_LEAST_PICTURE_PX, _LARGEST_PICTURE_PX = 160, 640
"""Longer side of a page's picture."""
_PICTURE_SAMPLES = 3.0
"""Along each axis of a picture's pixel at most: the maps of eight large cameras stay below 150 MB."""


_SHAPES = {
    "joints_world": (NUM_JOINTS, 3),
    "vertices_world": (NUM_VERTICES, 3),
    "root_world": (3,),
    "pose": (NUM_SKELETON_JOINTS, 3),
    "shape": (NUM_SHAPES,),
    "translation": (3,),
    "joint_sigma_m": (NUM_JOINTS,),
}
_POINTS = ("joints_world", "vertices_world", "root_world", "translation")
_WHERE_KNOWN = ("pose", "shape", "translation", "joint_sigma_m")
"""Left out of `prediction.npz` where no hand has them."""

_log = logging.getLogger(__name__)


def take_files(out: Path) -> list[Path]:
    """Return the files that belong to a take as a whole."""
    return [out / name for name in (PREDICTION, REPORT, PAGE, ANIMATION)]


class Written(NamedTuple):
    """What a reconstruction gave; the rest is on disk."""

    out: Path
    files: list[Path]
    """Everything that was written."""

    @property
    def arrays(self) -> dict[str, Array]:
        """The arrays of `prediction.npz`, read at every use."""
        with np.load(self.out / PREDICTION) as stored:
            return dict(stored)

    @property
    def report(self) -> dict[str, Any]:
        """The content of `report.json`, read at every use."""
        return json.loads((self.out / REPORT).read_text(encoding="utf-8"))


class Style(NamedTuple):
    """How hands are written."""

    faces: Mapping[str, Int[Array, "face 3"]]
    """Triangles by side."""
    meshes: bool
    """Whether to write the meshes of each frame."""
    animation: bool
    """Whether to write one animated mesh of the take."""
    origin_world: Float[Array, "3"]
    """Where the world in which the frames come has its origin in the capture's world."""
    joint_weights: Float[Array, "vert 21"] | None = None
    """How much each joint says about each vertex, for the page's colours; None = nothing is known of it."""


def write_results(
    frames: Iterable[Frame], take: Take, out: Path, style: Style, clock: Clock, about: Mapping[str, Any]
) -> Written:
    """Write meshes, overlays, arrays, page and report under `out`, `out/<frame>/...`, as the frames come.

    Args:
        frames: Judged, in order.
        take: The capture.
        out: Folder for the results.
        style: How to write.
        clock: What the report says of times.
        about: What the report says of the engine.

    Raises:
        FileNotFoundError, ValueError: No hand came out of the whole take; why.
    """
    safe_file_names(take.rig.names, "names of cameras")
    _check_names_are_free(out)
    writer = _Writer(take, out, style)
    try:
        for frame in frames:
            writer.add(frame)
        writer.report.check_any()
    except BaseException as stop:
        if writer.report.solved:
            name = "an interruption" if isinstance(stop, KeyboardInterrupt) else f"an error ({stop})"
            _log.warning("stopped by %s; %s holds the first %d frames", name, out, writer.report.frames)
            writer.finish(clock, {**about, "stopped_by": type(stop).__name__})
        raise
    else:
        writer.finish(clock, about)
    finally:
        writer.close()
    return Written(out, writer.files)


def _check_names_are_free(out: Path) -> None:
    """Raise ValueError where a folder has the name of a file of the results."""
    for path in take_files(out):
        if path.is_dir():
            raise ValueError(
                f"{path} is a folder, and a file of the results has this name: give another --out"
            )


class _Writer:
    """The files of one run, open while its frames come."""

    def __init__(self, take: Take, out: Path, style: Style) -> None:
        self.files: list[Path] = []
        self.report = Report(out / REPORT, take)
        self._take, self._out, self._style = take, out, style
        self._prediction = GrowingNpz(out / PREDICTION)
        self._names: list[str] = []
        self._unknown: set[str] = set(_WHERE_KNOWN)
        self._animation = AnimatedGlb(
            out / ANIMATION,
            {name: style.faces[side] for name, side in self._hands()},
            {name: HAND_RGB[side] for name, side in self._hands()},
            seconds_per_frame=SECONDS_PER_FRAME,
            origin=style.origin_world,
        )
        self._gallery = make_gallery(take.rig, take.num_frames)
        self._pages = PageFrames()

    def add(self, frame: Frame) -> None:
        """Write what belongs to a frame alone, and take it into what belongs to all."""
        for warning in self.report.add(frame):
            _log.warning("%s", warning)
        self._say_what_is_lost(frame)
        folder = frame_folder(self._out, frame.name)
        vertices = {
            name: hand.vertices_world
            for name, hand in zip(self._take.hand_names, frame.hands, strict=True)
            if hand.vertices_world is not None
        }
        self._write_meshes(folder, vertices)
        self._write_overlays(folder, frame, vertices)
        self._prediction.append(prediction_entry(frame, self._style.origin_world))
        self._names.append(frame.name)
        self._unknown -= {n for n in self._unknown for hand in frame.hands if getattr(hand, n) is not None}
        if self.report.solved and self._prediction.is_due():
            self._write_prediction()
        if self._style.animation:
            self._animation.add(vertices)
        if vertices:
            self._pages.offer(functools.partial(page_frame, frame, self._take, *self._gallery))

    def finish(self, clock: Clock, about: Mapping[str, Any]) -> None:
        """Write what belongs to all frames."""
        self.files.append(self._write_prediction())
        if self._style.animation:
            self.files.append(self._animation.write())
        elif is_own_mesh(self._out / ANIMATION):
            (self._out / ANIMATION).unlink()
        self._write_page(about)
        self.files.append(self.report.write(clock.rounded(), about))

    def close(self) -> None:
        """Let go of what is not needed any more."""
        for part in (self._prediction, self.report, self._animation):
            part.close()

    def _write_prediction(self) -> Path:
        constant = {
            "frames": self._names,
            "hand_side": self._take.hand_sides,
            "cameras": self._take.rig.names,
        }
        return self._prediction.write({k: np.array(v) for k, v in constant.items()}, self._unknown)

    def _hands(self) -> Iterable[tuple[str, str]]:
        return zip(self._take.hand_names, self._take.hand_sides, strict=True)

    def _write_meshes(self, folder: Path, vertices: Mapping[str, Array]) -> None:
        """Write the meshes of a frame; remove those of an earlier run that this one does not write."""
        for name, side in self._hands():
            for path in (folder / f"{name}{suffix}" for suffix in MESH_SUFFIXES):
                if self._style.meshes and name in vertices:
                    in_world = vertices[name] + self._style.origin_world
                    self.files.append(write_mesh(path, in_world, self._style.faces[side]))
                elif is_own_mesh(path):
                    path.unlink()

    def _write_overlays(self, folder: Path, frame: Frame, vertices: Mapping[str, Array]) -> None:
        rig, sides = self._take.rig, dict(self._hands())
        for view, image in enumerate(frame.images):
            if image is None:
                continue
            meshes = [
                MeshInView(
                    *project_raw(rig, view, mesh), self._style.faces[sides[name]], HAND_RGB[sides[name]]
                )
                for name, mesh in vertices.items()
            ]
            path = folder / f"overlay_{rig.names[view]}.png"
            self.files.append(write_png(path, draw_overlay(image, meshes)))

    def _write_page(self, about: Mapping[str, Any]) -> None:
        """Write the page if that can be done here; a warning says why not. The rest does not need it."""
        kept, style = self._pages.kept, self._style
        made = f"engine: {about['engine']}, {time.strftime('%d %B %Y, %H:%M')}"
        caption = Caption(self._out.resolve().name, made, page_facts(self.report, kept))
        more = {"caption": caption, "joint_weights": style.joint_weights}
        try:
            page = write_page(self._out / PAGE, kept, self._gallery.cameras, style.faces, **more)
            self.files.append(page)
        except OSError as error:
            _log.warning("the 3D page cannot be written, everything else is: %s", error)

    def _say_what_is_lost(self, frame: Frame) -> None:
        views = np.isfinite(frame.boxes_px).all(-1).sum(-1)
        for name, hand, seen in zip(self._take.hand_names, frame.hands, views, strict=True):
            if hand.reason is not None and seen > 1:
                _log.warning("frame %s: hand '%s' is left out: %s", frame.name, name, hand.reason)


def prediction_entry(frame: Frame, origin_world: Float[Array, "3"]) -> dict[str, Array]:
    """Return what `prediction.npz` holds of a frame; what was not reconstructed is NaN. Metres, world frame.

    `joints_world (H,21,3)`, `vertices_world (H,778,3)`, `root_world (H,3)`, `pose (H,16,3)`, `shape (H,10)`,
    `translation (H,3)`, `joint_sigma_m (H,21)`, `reprojection_px (H,V)`, `views_used (H,V)`, `valid (H,)`.
    Points are float64 where `origin_world`, which is added to them, is not zero; else numbers are float32.
    """
    hands = frame.hands
    entry = {
        "reprojection_px": np.full((len(hands), frame.boxes_px.shape[1]), np.nan, np.float32),
        "views_used": np.stack([hand.view_mask for hand in hands]),
        "valid": np.array([hand.reason is None for hand in hands]),
    }
    for name, shape in _SHAPES.items():
        far = name in _POINTS and origin_world.any()
        entry[name] = np.full((len(hands), *shape), np.nan, np.float64 if far else np.float32)
    for name in ("reprojection_px", *_SHAPES):
        for index, hand in enumerate(hands):
            value = getattr(hand, name)
            if value is not None:
                entry[name][index] = value + origin_world if name in _POINTS else value
    return entry


def frame_folder(out: Path, name: str) -> Path:
    """Return the folder of a frame's own files, which lies in `out` itself.

    Raises:
        ValueError: The name cannot be that of a folder, belongs to a file of the take, or is a link that
            leads elsewhere.
    """
    if safe_file_name(name, "a frame's name") in (PREDICTION, REPORT, PAGE, ANIMATION):
        raise ValueError(f"a frame cannot be called {name!r}: a file of the results has this name")
    folder = out / name
    if folder.is_symlink():
        raise ValueError(f"{folder} is a link that leads out of the folder of results: give another --out")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file, and the folder of a frame has this name: give another --out")
    return folder


def write_png(path: Path, image: UInt8[Array, "h w 3"]) -> Path:
    """Write an RGB image."""
    with whole_file(path) as temporary:
        ok, data = cv2.imencode(".png", image[..., ::-1])
        if not ok:
            raise OSError(f"cannot encode {path} as PNG")
        temporary.write_bytes(data.tobytes())
    return path


class Gallery(NamedTuple):
    """The small ideal cameras whose pictures the page shows at the places of a rig's cameras."""

    cameras: list[PageCamera]
    maps: list[PictureMap]


def make_gallery(rig: Rig, num_frames: int | None) -> Gallery:
    """Prepare the page's pictures; those of a take that is long, or may be (None), are smaller."""
    longer = picture_sides(rig, num_frames)
    pairs = [_page_camera(rig, view, longer[view]) for view in range(rig.num_views)]
    return Gallery([camera for camera, _ in pairs], [where for _, where in pairs])


def picture_sides(rig: Rig, num_frames: int | None) -> list[int]:
    """Return the longer side of each camera's pictures: all of a page together have `_PAGE_PIXELS`, but none
    is larger than its photograph, nor than a page can use, nor smaller than is worth looking at."""
    frames = PAGE_FRAMES if num_frames is None else min(num_frames, PAGE_FRAMES)
    shorter, longer = np.sort(rig.size_wh, axis=-1).T
    wanted = np.sqrt(_PAGE_PIXELS / (frames * rig.num_views) * longer / shorter)
    wanted = np.minimum(np.clip(wanted, _LEAST_PICTURE_PX, _LARGEST_PICTURE_PX), longer)
    return [int(side) for side in wanted]


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


def _page_camera(rig: Rig, view: int, longer: int) -> tuple[PageCamera, PictureMap]:
    """Make a pinhole with a central axis that looks at the middle of a photograph, whose own axis may not."""
    K, dist = rig.K[view], rig.dist[view]
    width, height = (int(size) for size in rig.size_wh[view])
    x, y = undistort_pixels(np.array([[width / 2, height / 2]]), K, dist)[0]
    ray = np.array([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], 1.0])
    R_cam_from_picture = smallest_rotation(np.array([0.0, 0.0, 1.0]), ray)
    scale = longer / max(width, height)
    # Off its axis an image is stretched by the squared length of the ray.
    focal_px = float(scale * (K[0, 0] + K[1, 1]) / 2 * (ray @ ray))
    hw = (round(scale * height), round(scale * width))
    K_picture = np.array([[focal_px, 0, hw[1] / 2], [0, focal_px, hw[0] / 2], [0, 0, 1]])
    T_picture_from_world = rigid(R_cam_from_picture.T, np.zeros(3)) @ rig.T_cam_from_world[view]
    where = picture_map(K, dist, K_picture, hw, min(1 / scale, _PICTURE_SAMPLES), R_cam_from_picture)
    return PageCamera(rig.names[view], T_picture_from_world, focal_px, hw), where
