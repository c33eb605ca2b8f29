"""The user's own captures (docs/captures.md) with labels, so that a model can be trained on one's own rig.

A capture is a folder with `rig.json` and the images of its cameras; its labels (`data/capture_labels.py`) are
what `poem fit` or `poem reconstruct` wrote of it, or the user's own. Every hand of every frame is a sample,
seen by those cameras whose image exists and shows most of its joints. Images are raw: their lens stays in the
frame (`MultiViewFrame.dist`), and K and key points are those of ideal pixels. `rig.json` counts pixels from a
pixel's centre; the half pixel is added where it is read.
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.data.capture_folder import (
    FramePaths,
    find_frames,
    find_rig,
    find_rig_file,
    frame_key,
    hand_names,
)
from poem_jax.data.capture_labels import CaptureLabels, find_labels, read_labels
from poem_jax.data.frames import CorruptSampleError, MultiViewFrame, check_frame
from poem_jax.data.lens import project_raw
from poem_jax.data.right_hand import as_right_hand
from poem_jax.data.sources.hand_in_views import hand_in_views
from poem_jax.data.sources.raw_sets import identify, identify_list, read_image
from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.rig import Rig
from poem_jax.hand.topology import NUM_SHAPES, NUM_SKELETON_JOINTS
from poem_jax.typing import Array, Bool, Float, Int

MIN_JOINTS_SHOWN = 11
"""Of 21, for a view to be used: more than half."""

_log = logging.getLogger(__name__)


class _Capture(NamedTuple):
    name: str
    folder: Path
    rig: Rig
    labels: CaptureLabels
    images: Mapping[str | int, FramePaths]
    """By `frame_key`."""


class _Place(NamedTuple):
    """Where a sample lies."""

    capture: int
    frame: int
    """Row of the labels."""
    hand: int
    views: tuple[int, ...]


class Captures:
    """Labelled captures in our format, one sample per hand and frame; see `FrameSource`."""

    def __init__(
        self,
        folders: str | Path | Sequence[str | Path],
        *,
        labels: Sequence[str | Path] | None = None,
        mano: str | Path | None = None,
        max_reprojection_px: float | None = None,
        joints_alone: bool = False,
    ) -> None:
        """Open captures and list their samples.

        Args:
            folders: One capture, or several.
            labels: File of labels per folder; None = the first of `LABEL_FILES` within it.
            mano: MANO_RIGHT.pkl or MANO_LEFT.pkl, for labels that hold pose and shape but no vertices.
            max_reprojection_px: Leave out views in which a fit lies farther than this, on average, from the
                key points it was made of (`reprojection_px` of its file); None = keep them.
            joints_alone: Take labels that are joints and nothing else, whose vertices are NaN: enough to
                evaluate a model.

        Raises:
            FileNotFoundError: A folder, its rig, its images or its labels are missing.
            ValueError: One of them is wrong, or no hand is left.
        """
        folders = [folders] if isinstance(folders, str | Path) else list(folders)
        if not folders or (labels is not None and len(labels) != len(folders)):
            count = "none" if not folders else f"{len(labels or ())} for {len(folders)} folders"
            raise ValueError(f"captures need folders, and one file of labels each if any; got {count}")
        files = [None] * len(folders) if labels is None else [Path(file) for file in labels]
        names = _names([Path(folder) for folder in folders])
        self._captures = [
            _open(name, Path(folder), file, mano, joints_alone)
            for name, folder, file in zip(names, folders, files, strict=True)
        ]
        self._places: list[_Place] = []
        for index, capture in enumerate(self._captures):
            self._places += _list_samples(index, capture, max_reprojection_px)
        self.name = "captures " + (names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more")
        self.max_views = max(len(place.views) for place in self._places)

    def __len__(self) -> int:
        return len(self._places)

    @property
    def takes(self) -> Int[Array, "sample 2"]:
        """Return capture and frame of each sample; see `TakesSource`."""
        return np.array([(place.capture, place.frame) for place in self._places])

    def __getitem__(self, index: int) -> MultiViewFrame:
        """Return the hand of one frame; see `FrameSource`."""
        place = self._places[index]
        capture = self._captures[place.capture]
        rig, labels, views = capture.rig, capture.labels, list(place.views)
        paths = capture.images[frame_key(labels.frames[place.frame])]
        key = _key(capture, place)
        try:
            vertices = labels.vertices(place.frame, place.hand)
        except (OSError, ValueError) as error:
            raise CorruptSampleError(labels.path, key, f"its vertices cannot be read: {error}") from error
        pose, shape = labels.pose_and_shape(place.frame, place.hand)
        T = rig.T_cam_from_world[views]
        joints = labels.joints_world[place.frame, place.hand]
        hand = hand_in_views(
            T,
            joints,
            vertices,
            np.zeros((NUM_SKELETON_JOINTS, 3)) if pose is None else pose,
            np.zeros(NUM_SHAPES) if shape is None else shape,
        )
        K = rig.K[views]
        frame = MultiViewFrame(
            key=key,
            images=tuple(read_image(_path(paths, view), key) for view in views),
            view_names=tuple(rig.names[view] for view in views),
            size_wh=rig.size_wh[views],
            K=K,
            T_cam_from_world=T,
            joints_cam=hand.joints_cam,
            vertices_cam=hand.vertices_cam,
            keypoints_px=project_cam(K, hand.joints_cam.astype(np.float64)),
            pose_cam=None if pose is None else hand.pose_cam,
            shape=None if shape is None else hand.shape,
            dist=rig.dist[views] if rig.dist[views].any() else None,
        )
        is_left = labels.sides[place.hand] == "left"
        frame = as_right_hand(frame) if is_left else frame
        return check_frame(frame, labels.path, joints_alone=labels.joints_alone)

    def fingerprint(self) -> Mapping[str, str]:
        """Return rig and labels of each capture, and the list of samples."""
        files = {}
        for capture in self._captures:
            files[f"{capture.name} rig"] = identify(find_rig_file(capture.folder))
            files[f"{capture.name} labels"] = identify(capture.labels.path)
        keys = (_key(self._captures[place.capture], place) for place in self._places)
        return files | {"samples": identify_list(keys)}


def _open(
    name: str, folder: Path, labels_file: Path | None, mano: str | Path | None, joints_alone: bool
) -> _Capture:
    rig = find_rig(folder)
    images = {frame_key(frame.name): frame for frame in find_frames(folder, rig.names)}
    labels_file = find_labels(folder) if labels_file is None else labels_file
    labels = read_labels(labels_file, mano=mano, joints_alone=joints_alone)
    if labels.cameras is not None and not set(labels.cameras) & set(rig.names):
        raise ValueError(
            f"{labels.path} is of the cameras {', '.join(labels.cameras)}, and the rig of {folder} has "
            f"{', '.join(rig.names)}: labels belong to the world of their own rig"
        )
    if len(images) == len(labels.frames) == 1:
        images = {frame_key(labels.frames[0]): frame for frame in images.values()}
    return _Capture(name, folder, rig, labels, images)


def _list_samples(index: int, capture: _Capture, max_reprojection_px: float | None) -> list[_Place]:
    """List the hands that at least one view shows, and say how many are left out, and why."""
    labels = capture.labels
    usable = _shown(capture.rig, labels.joints_world)
    if max_reprojection_px is not None:
        usable &= _close(capture, max_reprojection_px)
    places, without_images = [], 0
    for row, name in enumerate(labels.frames):
        paths = capture.images.get(frame_key(name))
        if paths is None:
            without_images += 1
            continue
        has_image = np.array([path is not None for path in paths.images])
        for hand in range(len(labels.sides)):
            views = np.flatnonzero(usable[row, hand] & has_image)
            if len(views):
                places.append(_Place(index, row, hand, tuple(views.tolist())))
    hands = labels.joints_world.shape[0] * len(labels.sides)
    lost = hands - int(np.isfinite(labels.joints_world).all((-2, -1)).sum())
    if not places:
        raise ValueError(
            f"{capture.folder} has no usable sample: of {hands} hands in {labels.path}, {lost} have no "
            f"label, and {without_images} of {len(labels.frames)} frames have no images of that name"
        )
    _log.info(
        "%s: %d samples of %d hands; %d hands have no label, %d frames no images",
        *(capture.folder, len(places), hands, lost, without_images),
    )
    return places


def _shown(rig: Rig, joints_world: Float[Array, "frame hand 21 3"]) -> Bool[Array, "frame hand view"]:
    """Tell which cameras have a hand before them and most of its joints within their image."""
    known = np.isfinite(joints_world).all((-2, -1))
    points = np.where(known[..., None, None], joints_world, 0.0)
    shown = []
    for view in range(rig.num_views):
        uv, points_cam = project_raw(rig, view, points.reshape(-1, 3))
        with np.errstate(invalid="ignore"):
            inside = ((uv >= 0) & (uv <= rig.size_wh[view])).all(-1).reshape(points.shape[:-1])
        ahead = (points_cam[:, 2] > 0).reshape(points.shape[:-1]).all(-1)
        shown.append(known & ahead & (inside.sum(-1) >= MIN_JOINTS_SHOWN))
    return np.stack(shown, -1)


def _close(capture: _Capture, limit_px: float) -> Bool[Array, "frame hand view"]:
    """Tell in which views of the rig a fit is within `limit_px` of its key points."""
    labels = capture.labels
    if labels.reprojection_px is None or labels.cameras is None:
        raise ValueError(
            f"`max_reprojection_px` needs `reprojection_px (F, H, V)` and `cameras (V,)` in {labels.path}, "
            "as `poem fit` writes them"
        )
    column = {camera: i for i, camera in enumerate(labels.cameras)}
    close = [
        labels.reprojection_px[..., column[name]] <= limit_px
        if name in column
        else np.zeros(labels.reprojection_px.shape[:2], bool)
        for name in capture.rig.names
    ]
    return np.stack(close, -1)


def _key(capture: _Capture, place: _Place) -> str:
    hand = hand_names(capture.labels.sides)[place.hand]
    return f"{capture.name}/{capture.labels.frames[place.frame]}/{hand}"


def _path(paths: FramePaths, view: int) -> Path:
    path = paths.images[view]
    assert isinstance(path, Path), "find_frames lists files"
    return path


def _names(folders: Sequence[Path]) -> list[str]:
    """Name each capture by its folder, or by the whole path where two folders are called the same."""
    short = [folder.resolve().name for folder in folders]
    names = [
        name if short.count(name) == 1 else str(folder) for name, folder in zip(short, folders, strict=True)
    ]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"the capture {twice} is given twice")
    return names
