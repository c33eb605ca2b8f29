"""What every data set gives, whatever its files look like: `MultiViewFrame`, one right hand in all cameras.

A source (`data/sources/`, one file a data set) turns its data set's conventions into ours, once, and nobody
after it knows them: metres, OpenCV camera axes, `T_cam_from_world`, 21 joints in OpenPose order, zero pose =
flat hand, pixels where the image spans [0, W] x [0, H]. Labels stay those of each camera as stored, in that
camera's frame: which camera becomes the world is drawn later (`view_sampling.py`), and the truth is then what
was stored for that one.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from poem_jax.data.frame_agreement import disagreements
from poem_jax.geometry.camera_checks import ROTATION_TOLERANCE, has_form_of_intrinsics, rotation_error
from poem_jax.geometry.distortion import TERM_COUNTS
from poem_jax.typing import Array, Float, Int

HAND_EXTENT_M = (0.04, 0.4)
"""Twice the largest distance of a joint, or vertex, from the mean of all: about 0.24 for an open hand,
0.1 for a child's fist."""
FARTHEST_M = 20.0
"""Of a hand from a camera."""


class CorruptSampleError(ValueError):
    """One sample cannot be used. The message names its file, its key, and what is wrong."""

    def __init__(self, path: str | Path, key: str, problem: str) -> None:
        super().__init__(f"{path}, sample {key}: {problem}")
        self.path, self.key, self.problem = str(path), key, problem

    def __reduce__(self) -> tuple:
        return type(self), (self.path, self.key, self.problem)


class EncodedImage(NamedTuple):
    """A JPEG or PNG as it lies in its file; `data/pictures.py` decodes it."""

    data: bytes
    name: str
    """Where it comes from, for messages: a path, or `archive.tar: member`."""


class MultiViewFrame(NamedTuple):
    """One right hand at one instant, in all cameras that the data set keeps for it, as NumPy.

    The data set's own order of the views; where it has a constant master camera (DexYCB, HO-3D, OakInk),
    that one is first.
    """

    key: str
    """Names the sample within its source; unique there."""
    images: tuple[EncodedImage, ...]
    view_names: tuple[str, ...]
    """Cameras, as the data set calls them."""
    size_wh: Int[Array, "view 2"]
    """Of the images as calibrated, pixels."""
    K: Float[Array, "view 3 3"]
    T_cam_from_world: Float[Array, "view 4 4"]
    """Any one world for all views."""
    joints_cam: Float[Array, "view 21 3"]
    """Each view's own label, metres in that camera's frame."""
    vertices_cam: Float[Array, "view 778 3"]
    """NaN throughout where labels are joints alone, which a source gives only if it is asked to."""
    keypoints_px: Float[Array, "view 21 2"]
    """The joints in each image, also where they lie outside."""
    pose_cam: Float[Array, "view 16 3"] | None = None
    """Axis-angle, MANO order, zero = flat hand; `[:, 0]` turns the hand into the camera's frame. None where
    the data set has none."""
    shape: Float[Array, "view 10"] | None = None
    box_px: Float[Array, "view 4"] | None = None
    """x0 y0 x1 y1 of the hand where the data set prescribes one; None = that of the key points."""
    mirror_px: Float[Array, " view"] | None = None
    """None: images show the hand as labelled. Else it is a left hand, given as the right hand that a mirror
    shows: everything here (K, extrinsics, labels) is that of the mirrored hand already, and each stored image
    must still be turned left to right about the column u = mirror_px, u' = 2 mirror_px - u, where
    mirror_px = cx keeps K."""
    dist: Float[Array, "view term"] | None = None
    """Lens of the stored images, the terms of `geometry.distortion`, as calibrated (not mirrored);
    None: they have no distortion. K, key points and boxes are those of the ideal image that the same K would
    see without it: crops are sampled through the lens (`data/lens.py`)."""


@runtime_checkable
class FrameSource(Protocol):
    """A data set, or one split of it, by index. Sources are small, can be pickled (worker processes get
    them), and open files when they are asked."""

    name: str
    """In logs, reports and errors: `dexycb s0 train`."""
    max_views: int
    """Most views of any frame."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> MultiViewFrame:
        """Read one frame, checked by `check_frame`.

        Raises: CorruptSampleError: this frame cannot be used; others may be.
        """
        ...

    def fingerprint(self) -> Mapping[str, str]:
        """Return the files on which the list of samples depends: name -> what identifies its content (size,
        checksum). A run that goes on compares it with that of its start."""
        ...


@runtime_checkable
class DamagedSource(FrameSource, Protocol):
    """A source that opens although some of its files are damaged, and says what it leaves out."""

    @property
    def faults(self) -> Sequence[CorruptSampleError]:
        """What was found, one a sample or a file."""
        ...

    @property
    def lost_samples(self) -> int:
        """About how many samples it lacks for that: at least one a fault."""
        ...


@runtime_checkable
class TakesSource(FrameSource, Protocol):
    """A source that tells which of its samples were taken one after another."""

    @property
    def takes(self) -> Int[Array, "sample 2"]:
        """Number of the take (capture, shard) of each sample, and of the instant within it, in order."""
        ...


def check_frame(frame: MultiViewFrame, path: str | Path, *, joints_alone: bool = False) -> MultiViewFrame:
    """Return the frame if it can be true, and round nothing.

    Args:
        frame: what a source has made.
        path: where it comes from, for messages.
        joints_alone: its labels have no vertices; these are not looked at.

    Raises: CorruptSampleError: numbers that are not finite, K that is no camera, extrinsics that are not
        rigid, a hand behind a camera or of a size that no hand has, numbers that do not fit each other.
    """
    problem = next(_problems(frame, ("joints_cam",) if joints_alone else _POINTS), None)
    if problem is not None:
        raise CorruptSampleError(path, frame.key, problem)
    return frame


def _problems(frame: MultiViewFrame, points_of: tuple[str, ...]) -> Iterator[str]:
    """Yield what is wrong, one line each."""
    views = len(frame.images)
    if not views:
        yield "it has no image"
    for name, tail in _TAILS.items():
        value = getattr(frame, name)
        if value is None or (name in _POINTS and name not in points_of):
            continue
        if np.shape(value) != (views, *tail):
            yield f"`{name}` must have shape {(views, *tail)} for {views} images; got {np.shape(value)}"
            return
        bad = ~np.isfinite(np.asarray(value, np.float64)).reshape(views, -1).all(-1)
        if bad.any():
            yield f"`{name}` is not finite in {_views(frame, bad)}"
    if frame.dist is not None:
        terms = np.asarray(frame.dist, np.float64)
        if terms.ndim != 2 or terms.shape[0] != views or terms.shape[1] not in TERM_COUNTS:
            counts = ", ".join(map(str, TERM_COUNTS))
            yield f"`dist` must have a row of {counts} terms for each of {views} images; got {terms.shape}"
        elif not np.isfinite(terms).all():
            yield f"`dist` is not finite in {_views(frame, ~np.isfinite(terms).all(-1))}"
    if len(frame.view_names) != views:
        yield f"it has {len(frame.view_names)} names of views for {views} images"
        return
    bad = ~has_form_of_intrinsics(frame.K) | (frame.K[:, 0, 0] <= 0) | (frame.K[:, 1, 1] <= 0)
    if bad.any():
        yield f"K is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx, fy in {_views(frame, bad)}"
    R, last = frame.T_cam_from_world[:, :3, :3], frame.T_cam_from_world[:, 3]
    bad = (rotation_error(R) > ROTATION_TOLERANCE) | (np.linalg.det(R) <= 0)
    bad |= (np.abs(last - [0, 0, 0, 1]) > 1e-6).any(-1)
    if bad.any():
        yield f"the extrinsic is not rigid (R R^T = 1, det R = 1, last row 0 0 0 1) in {_views(frame, bad)}"
    if frame.box_px is not None:
        bad = (frame.box_px[:, :2] >= frame.box_px[:, 2:]).any(-1)
        if bad.any():
            yield f"`box_px` is not x0 y0 x1 y1 with x0 < x1 and y0 < y1 in {_views(frame, bad)}"
    for name in points_of:
        points = getattr(frame, name)
        extent = np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1).max(-1)
        bad = (2 * extent < HAND_EXTENT_M[0]) | (2 * extent > HAND_EXTENT_M[1])
        if bad.any():
            sizes = ", ".join(f"{2 * e:.3g}" for e in extent[bad])
            yield (
                f"`{name}` is a hand of {sizes} m in {_views(frame, bad)}; a hand has "
                f"{HAND_EXTENT_M[0]} to {HAND_EXTENT_M[1]} m"
            )
        depth = points[..., 2]
        bad = (depth.mean(-1) <= 0) | (depth.mean(-1) > FARTHEST_M)
        if bad.any():
            yield f"`{name}` lies {depth.mean(-1)[bad][0]:.3g} m before the camera in {_views(frame, bad)}"
    yield from disagreements(
        frame.K,
        frame.T_cam_from_world,
        frame.joints_cam,
        frame.keypoints_px,
        list(map(str, frame.view_names)),
    )


_POINTS = ("joints_cam", "vertices_cam")
_TAILS = {
    "size_wh": (2,),
    "K": (3, 3),
    "T_cam_from_world": (4, 4),
    "joints_cam": (21, 3),
    "vertices_cam": (778, 3),
    "keypoints_px": (21, 2),
    "pose_cam": (16, 3),
    "shape": (10,),
    "box_px": (4,),
    "mirror_px": (),
}
"""Shape of each array behind its `view` axis."""


def _views(frame: MultiViewFrame, bad: Array) -> str:
    names = [str(frame.view_names[i]) if i < len(frame.view_names) else str(i) for i in np.flatnonzero(bad)]
    return "view " + ", ".join(names)
