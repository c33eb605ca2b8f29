"""What a take holds and what came of it, frame by frame."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.capture.boxes_file import (
    HOW_TO_GET_BOXES,
    HandBoxes,
    align_boxes,
    read_boxes,
    without_boxes_outside,
)
from poem_jax.capture.folder import FramePaths, find_frames
from poem_jax.capture.rig_file import find_rig
from poem_jax.capture.samples import HandResult
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.world_origin import distant_origin
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES, NUM_SKELETON_JOINTS, NUM_VERTICES
from poem_jax.io.images import read_image
from poem_jax.typing import Array, Bool, Float, UInt8

BOXES_FILES = ("boxes.npz",)


class Take(NamedTuple):
    """A capture as read from disk, images excepted."""

    rig: Rig
    frames: list[FramePaths]
    hands: HandBoxes
    """Aligned with `frames`."""

    @property
    def hand_names(self) -> tuple[str, ...]:
        """One file-safe name per hand: its side, numbered where a side comes more than once."""
        return hand_names(self.hands.hand_side)


class HandOutcome(NamedTuple):
    """One hand of one frame."""

    result: HandResult | None
    """In the capture's world; None where it could not be reconstructed."""
    view_mask: Bool[Array, " view"]
    """Views that were used."""
    reprojection_px: Float[Array, " view"]
    """Mean distance to the 2D evidence; NaN = none in this view."""
    joints_shown: Float[Array, " view"]
    """Share of the joints that the view's lens shows; NaN = not used."""
    reason: str | None = None
    """Why there is no result."""


class ImageProblem(NamedTuple):
    """An image that is missing or cannot be read; its view is masked."""

    needed: bool
    """Whether there is a box in it."""
    error: FileNotFoundError | ValueError


class FrameImages(NamedTuple):
    """The images of one moment, as far as they can be read."""

    images: list[UInt8[Array, "h w 3"] | None]
    """One per camera of the rig."""
    problems: tuple[ImageProblem, ...]


class FrameOutcome(NamedTuple):
    """One frame."""

    hands: tuple[HandOutcome, ...]
    problems: tuple[ImageProblem, ...] = ()

    @property
    def solved(self) -> bool:
        """Whether any hand was reconstructed."""
        return any(hand.result is not None for hand in self.hands)

    @property
    def failed(self) -> bool:
        """Whether there was something to reconstruct, and nothing was."""
        return not self.solved and (bool(self.problems) or any(hand.view_mask.any() for hand in self.hands))


def read_take(
    folder: str | os.PathLike, rig: str | os.PathLike | None = None, boxes: str | os.PathLike | None = None
) -> Take:
    """Read rig and boxes of a capture, and list its frames.

    Args:
        folder: One image per camera, or `frames/<frame>/<camera>.jpg`.
        rig: Rig file; None = `rig.json` or `calibration/rig.json` in the folder.
        boxes: File of boxes or key points; None = `boxes.npz` in the folder.

    Raises:
        FileNotFoundError: Folder, rig, boxes or images are missing.
        ValueError: One of them is wrong.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no capture folder at {folder}")
    found = find_rig(folder, rig)
    frames = find_frames(folder, found.names)
    boxes_file = _given_or_found(boxes, folder, BOXES_FILES, HOW_TO_GET_BOXES)
    names = tuple(frame.name for frame in frames)
    hands = align_boxes(read_boxes(boxes_file), names, found.names, boxes_file)
    return Take(found, frames, without_boxes_outside(hands, found.size_wh))


def hand_names(sides: tuple[str, ...]) -> tuple[str, ...]:
    """Return `right`, `left`, or `right_0`, `right_1` where a side comes more than once."""
    return tuple(
        side if sides.count(side) == 1 else f"{side}_{sides[:i].count(side)}" for i, side in enumerate(sides)
    )


def read_frame(take: Take, frame: int, *, images_needed: bool = True) -> FrameImages:
    """Read the images of a frame, and note those that are needed but missing, and those that are damaged.

    A camera without a file is no problem if it sees no hand, or if the images are only drawn on.
    """
    needed = np.isfinite(take.hands.boxes_px[frame]).all(-1).any(0) & images_needed
    images: list[UInt8[Array, "h w 3"] | None] = []
    problems = []
    for view in range(take.rig.num_views):
        image, error = _read_view(take, frame, view, bool(needed[view]))
        images.append(image)
        if error is not None:
            problems.append(ImageProblem(bool(needed[view]), error))
    return FrameImages(images, tuple(problems))


def _read_view(
    take: Take, frame: int, view: int, needed: bool
) -> tuple[UInt8[Array, "h w 3"] | None, FileNotFoundError | ValueError | None]:
    name, path = take.frames[frame].name, take.frames[frame].images[view]
    if path is None:
        camera = take.rig.names[view]
        error = FileNotFoundError(
            f"frame {name}: camera '{camera}' has a box but no image; expected {camera}.jpg or .png "
            "(to leave the view out, give it NaN boxes)"
        )
        return None, error if needed else None
    try:
        width, height = take.rig.size_wh[view]
        return read_image(path, (int(width), int(height))), None
    except (FileNotFoundError, ValueError) as error:
        return None, error


def prediction_arrays(take: Take, outcomes: list[FrameOutcome]) -> dict[str, Array]:
    """Stack outcomes into the arrays of `prediction.npz`; what was not reconstructed is NaN.

    Returns:
        `joints_world (F,H,21,3)`, `vertices_world (F,H,778,3)`, `root_world (F,H,3)`, `reprojection_px
        (F,H,V)`, `views_used (F,H,V)`, `valid (F,H)`, `frames (F,)`, `hand_side (H,)`, `cameras (V,)`, and
        where the engine gives them `pose (F,H,16,3)`, `shape (F,H,10)`, `translation (F,H,3)` and
        `joint_sigma_m (F,H,21)`. Metres, world frame.
    """
    counts = (len(outcomes), len(take.hands.hand_side))
    shapes = {
        "joints_world": (NUM_JOINTS, 3),
        "vertices_world": (NUM_VERTICES, 3),
        "root_world": (3,),
        "pose": (NUM_SKELETON_JOINTS, 3),
        "shape": (NUM_SHAPES,),
        "translation": (3,),
        "joint_sigma_m": (NUM_JOINTS,),
    }
    arrays: dict[str, Array] = {
        name: np.full((*counts, *shape), np.nan, np.float32) for name, shape in shapes.items()
    }
    arrays["reprojection_px"] = np.full((*counts, take.rig.num_views), np.nan, np.float32)
    arrays["views_used"] = np.zeros((*counts, take.rig.num_views), bool)
    arrays["valid"] = np.zeros(counts, bool)
    for name in ("joints_world", "vertices_world", "root_world", "translation"):
        if distant_origin(take.rig.T_cam_from_world).any():
            arrays[name] = arrays[name].astype(np.float64)
    for frame, outcome in enumerate(outcomes):
        for hand, solved in enumerate(outcome.hands):
            arrays["views_used"][frame, hand] = solved.view_mask
            arrays["reprojection_px"][frame, hand] = solved.reprojection_px
            arrays["valid"][frame, hand] = solved.result is not None
            for name in shapes:
                value: Any = None if solved.result is None else getattr(solved.result, name)
                if value is not None:
                    arrays[name][frame, hand] = value
    for name in ("pose", "shape", "translation", "joint_sigma_m"):
        if not np.isfinite(arrays[name]).any():
            del arrays[name]
    arrays["frames"] = np.array([frame.name for frame in take.frames])
    arrays["hand_side"] = np.array(take.hands.hand_side)
    arrays["cameras"] = np.array(take.rig.names)
    return arrays


def _given_or_found(
    given: str | os.PathLike | None, folder: Path, candidates: tuple[str, ...], help_text: str
) -> Path:
    if given is not None:
        return Path(given)
    found = next((folder / name for name in candidates if (folder / name).is_file()), None)
    if found is None:
        looked = " or ".join(str(folder / name) for name in candidates)
        raise FileNotFoundError(f"no {looked}: {help_text}")
    return found
