"""The stage `write`: what a reconstruction leaves on disk, written as the frames come.

Every file appears whole or not at all. If the stream ends early, by Ctrl-C or an error, what was done is
written before the exception goes on its way. Each kind of file has a home of its own in `outputs/`.
"""

import functools
import json
import logging
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.capture.frame import Frame
from poem_jax.capture.outputs.exports import ANIMATION, export_files, write_exports
from poem_jax.capture.outputs.formats import DEFAULT_FORMATS, Format
from poem_jax.capture.outputs.labelled_capture import LabelledCapture
from poem_jax.capture.outputs.meshes import remove_own_meshes, write_frame_meshes
from poem_jax.capture.outputs.overlays import Drawn, OverlayVideos, draw_views, write_png
from poem_jax.capture.outputs.page import PageFrames, is_long, make_gallery
from poem_jax.capture.outputs.page_frame import page_facts, page_frame
from poem_jax.capture.outputs.prediction import PredictionFile
from poem_jax.capture.report import Clock, Report
from poem_jax.capture.take import Take
from poem_jax.hand.joint_weights import vertex_joint_weights
from poem_jax.hand.model import HandModel
from poem_jax.io.file_names import safe_file_name, safe_file_names
from poem_jax.io.meshes import is_own_mesh
from poem_jax.typing import Array, Float, Int
from poem_jax.viz.page import Caption, write_page

PREDICTION, REPORT, PAGE = "prediction.npz", "report.json", "index.html"
OVERLAYS = "overlays"
"""Folder of the overlay videos, apart from a capture's own, should both be in one place."""
CAPTURE = "capture"
"""Folder of the take as a labelled capture."""

_log = logging.getLogger(__name__)


def take_files(out: Path) -> list[Path]:
    """Return the files that belong to a take as a whole, whatever is chosen to be written."""
    exports = export_files(out, ("right", "left"), frozenset(Format))
    return [*(out / name for name in (PREDICTION, REPORT, PAGE)), *exports]


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
    hands: Mapping[str, HandModel] | None = None
    """The hand models by side that poses and meshes are of; None = not known."""
    formats: frozenset[Format] = DEFAULT_FORMATS
    """What is written beyond arrays, page, report and overlays."""

    @property
    def of_take(self) -> frozenset[Format]:
        """The formats without the animation where there is none to be."""
        return self.formats if self.animation else self.formats - {Format.GLB}

    def joint_weights(self) -> Float[Array, "vert 21"] | None:
        """Return how much each joint says about each vertex, None where nothing is known of it."""
        if self.hands is None:
            return None
        hand = self.hands["right"]
        return vertex_joint_weights(hand.v_template, hand.J_regressor, hand.weights)


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
        self._prediction = PredictionFile(out / PREDICTION, take, style.origin_world)
        sides = zip(take.hand_names, take.hand_sides, strict=True)
        self._drawn = {name: Drawn(style.faces[side], side) for name, side in sides}
        chosen = style.formats & {Format.VIDEO, Format.PNG}
        self._overlays = chosen or {Format.VIDEO if is_long(take.num_frames) else Format.PNG}
        self._videos = OverlayVideos([out / OVERLAYS / f"{name}.mp4" for name in take.rig.names])
        labelled = LabelledCapture(out / CAPTURE, take.rig, style.origin_world)
        self._capture = labelled if Format.CAPTURE in style.formats else None
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
        if self._capture is not None:
            self._capture.add(frame)
        self._prediction.add(frame)
        if self.report.solved and self._prediction.is_due():
            self._prediction.write()
        if vertices:
            self._pages.offer(functools.partial(page_frame, frame, self._take, *self._gallery))

    def finish(self, clock: Clock, about: Mapping[str, Any]) -> None:
        """Write what belongs to all frames; if a part of it cannot be, the rest is there."""
        prediction = self._prediction.write()
        self.files.append(prediction)
        exported: Mapping[str, Any] = {}
        try:
            self.files += self._videos.finish()
            if self._capture is not None:
                self.files += self._capture.finish(prediction)
        finally:
            try:
                exported = self._write_exports()
            finally:
                self._write_page(about)
                self.files.append(self.report.write(clock.rounded(), {**about, **exported}))

    def close(self) -> None:
        """Let go of what is not needed any more."""
        for part in (self._prediction, self.report, self._videos):
            part.close()

    def _write_meshes(self, folder: Path, vertices: Mapping[str, Array]) -> None:
        """Write the meshes of a frame; remove those of an earlier run that this one does not write."""
        written = vertices if self._style.meshes else {}
        in_world = {name: mesh + self._style.origin_world for name, mesh in written.items()}
        faces = {name: hand.faces for name, hand in self._drawn.items()}
        self.files += write_frame_meshes(folder, in_world, faces)
        remove_own_meshes(folder, [name for name in faces if name not in written])

    def _write_overlays(self, folder: Path, frame: Frame, vertices: Mapping[str, Array]) -> None:
        if not frame.images:
            return
        images = draw_views(frame, self._take.rig, vertices, self._drawn)
        if Format.VIDEO in self._overlays:
            self._videos.add(frame.time_s, images)
        if Format.PNG in self._overlays:
            for camera, image in zip(self._take.rig.names, images, strict=True):
                if image is not None:
                    self.files.append(write_png(folder / f"overlay_{camera}.png", image))

    def _write_exports(self) -> Mapping[str, Any]:
        """Write the files for other programs; return what the report says of them."""
        style, take = self._style, self._take
        exports = write_exports(
            *(self._out, take, self._prediction, style.hands, style.faces, style.of_take, style.origin_world)
        )
        self.files += exports.files
        if ANIMATION not in {path.name for path in exports.files} and is_own_mesh(self._out / ANIMATION):
            (self._out / ANIMATION).unlink()
        for path in export_files(self._out, take.hand_names, frozenset(Format)):
            if path not in exports.files and path.exists():
                _log.warning("%s is of an earlier run, and does not belong to these results", path)
        return exports.about

    def _write_page(self, about: Mapping[str, Any]) -> None:
        """Write the page if that can be done here; a warning says why not. The rest does not need it."""
        kept, style = self._pages.kept, self._style
        if not kept:  # Stopped within the first frame that has hands.
            return
        made = f"engine: {about['engine']}, {time.strftime('%d %B %Y, %H:%M')}"
        caption = Caption(self._out.resolve().name, made, page_facts(self.report, kept))
        more = {"caption": caption, "joint_weights": style.joint_weights()}
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


def frame_folder(out: Path, name: str) -> Path:
    """Return the folder of a frame's own files, which lies in `out` itself.

    Raises:
        ValueError: The name cannot be that of a folder, belongs to a file of the take, or is a link that
            leads elsewhere.
    """
    taken = {OVERLAYS, CAPTURE, *(path.name for path in take_files(out))}
    if safe_file_name(name, "a frame's name") in taken:
        raise ValueError(f"a frame cannot be called {name!r}: one of the results has this name")
    folder = out / name
    if folder.is_symlink():
        raise ValueError(f"{folder} is a link that leads out of the folder of results: give another --out")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file, and the folder of a frame has this name: give another --out")
    return folder
