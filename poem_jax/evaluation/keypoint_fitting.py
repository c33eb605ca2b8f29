"""Key-point fitting as a system: 2D key points of each view, and a hand model fitted to them.

Key points come from our own detector, which looks at the crops that a network would get, or from a file. The
solver is the paper's Adam, or the one of `poem fit`. The authors' Adam begins near the flat hand at one place
before the camera (`fitting.adam.released_start`); here it begins where `poem fit` does, at the pose in closed
form. Its term of silhouettes needs masks that no data set brings, and is left out.
"""

import enum
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.augmentation_recipes import NONE
from poem_jax.detection.detector import find_hands
from poem_jax.evaluation.systems import Answer, Seen
from poem_jax.fitting import (
    FitConfig,
    KeypointNoise,
    Observations,
    fit_take,
    fit_take_adam,
    keypoint_model,
    triangulate_robust,
)
from poem_jax.fitting.adam import AdamParameters
from poem_jax.fitting.detector_offsets import MEDIAPIPE_HANDS, offsets_of
from poem_jax.fitting.kinematics import KeypointModel
from poem_jax.fitting.lm import LMConfig, ShapeMode
from poem_jax.fitting.start import closed_form_pose
from poem_jax.geometry.cameras import anchor_to_primary
from poem_jax.geometry.transforms import quaternion_from_rotation, rotation_from_axis_angle
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES
from poem_jax.io.npz_file import read_npz
from poem_jax.typing import Float

CROP_SIDE_PX = 256
"""Of the crops in which hands are looked for: the networks' own size, and the paper's."""


class Solver(enum.Enum):
    """How a hand is fitted to its key points, every sample by itself."""

    ADAM = "the paper's Adam"
    LEVENBERG_MARQUARDT = "`poem fit`"


class KeypointFitting:
    """Key points and a solver; see `System`."""

    def __init__(
        self,
        hand: HandModel,
        keypoints: Mapping[str, Float[np.ndarray, "view 21 2"]] | None = None,
        *,
        solver: Solver = Solver.ADAM,
    ) -> None:
        """Take a right hand, and key points by the frames' keys; None = they are found in the crops.

        Args:
            hand: a model of a right hand.
            keypoints: pixels of the undistorted images, which span [0, W] x [0, H]; the frame's own order of
                views, OpenPose order, NaN = unseen. A frame that is missing has none.
            solver: of the two.
        """
        self.hand, self.image_hw, self.recipe = hand, (CROP_SIDE_PX, CROP_SIDE_PX), NONE
        self.least_views, self.takes_root, self.one_at_a_time = 2, False, False
        self.most_views: int | None = None
        self._keypoints, self._solver = keypoints, solver
        self._asked, self._any_known = "", False
        self._model = keypoint_model(hand, offsets_of(MEDIAPIPE_HANDS) if keypoints is None else None)

    def __call__(self, batch: MultiViewBatch, seen: Sequence[Seen]) -> Answer:
        """Fit one hand per sample; one that two views do not show is not valid."""
        observed, diagonal_px = (
            self._in_crops(batch) if self._keypoints is None else self._in_images(batch, seen)
        )
        noise = KeypointNoise.of_images(np.full((1, 2), diagonal_px / np.sqrt(2)))
        config = FitConfig(LMConfig(shape_mode=ShapeMode.PER_FRAME), noise)
        if self._solver is Solver.ADAM:
            start = _closed_form(self._model, observed, noise=noise)
            found = fit_take_adam(self._model, observed, start, config=config, diagonal_px=diagonal_px)
        else:
            found = fit_take(self._model, observed, config=config)
        return Answer(*map(np.asarray, (found.joints, found.vertices, found.valid)))

    @property
    def unknown_keys(self) -> str | None:
        """What is wrong with a file that knew none of the frames so far; None = nothing."""
        if self._keypoints is None or self._any_known or not self._asked:
            return None
        own = next(iter(self._keypoints), None)
        return (
            f"key points must be stored under the keys of the frames, such as {self._asked!r}; the file "
            f"knows none of them, and has keys such as {own!r}"
        )

    def _in_crops(self, batch: MultiViewBatch) -> tuple[Observations, float]:
        """Look for the right hand in every valid crop; the surest, where there are more."""
        shown = np.argwhere(np.asarray(batch.cameras.view_mask))
        uv = np.full((*batch.views.shape[:2], NUM_JOINTS, 2), np.nan, np.float32)
        hands = find_hands([np.asarray(batch.views[i, v]) for i, v in shown])
        for (sample, view), found in zip(shown, hands, strict=True):
            if found:
                right = [hand for hand in found if hand.side == "right"] or found
                uv[sample, view] = max(right, key=lambda hand: hand.score).keypoints_px
        K, T_cam_from_world, _ = batch.cameras
        return Observations(uv, None, np.asarray(K), np.asarray(T_cam_from_world)), CROP_SIDE_PX * np.sqrt(2)

    def _in_images(self, batch: MultiViewBatch, seen: Sequence[Seen]) -> tuple[Observations, float]:
        """Take the file's key points, with the cameras of whole images.

        Raises:
            ValueError: key points of another number of views, or cameras that were changed after the frames
                were read.
        """
        assert self._keypoints is not None
        size, views = batch.views.shape[:2]
        uv = np.full((size, views, NUM_JOINTS, 2), np.nan, np.float32)
        K, T = np.array(batch.cameras.K), np.array(batch.cameras.T_cam_from_world)
        diagonals = []
        for place, (frame, chosen) in enumerate(seen):
            count = len(chosen)
            own = anchor_to_primary(frame.T_cam_from_world[chosen], np.ones(count, bool))[0]
            shown = np.asarray(batch.cameras.view_mask[place])
            if shown.sum() != count or not np.allclose(T[place][shown], own, atol=1e-5):
                raise ValueError(
                    f"key points of a file go with the cameras of {frame.key} as they were read; these were "
                    "changed. Score changed cameras with a network, or with key points found in the crops"
                )
            K[place, :count], T[place, :count] = frame.K[chosen], own
            diagonals.append(np.linalg.norm(frame.size_wh[chosen], axis=-1).mean())
            self._asked = self._asked or frame.key
            if (points := self._keypoints.get(frame.key)) is not None:
                self._any_known = True
                if len(points) != len(frame.images):
                    raise ValueError(
                        f"key points of {frame.key} must be those of its {len(frame.images)} views "
                        f"({', '.join(frame.view_names)}); got {len(points)} views"
                    )
                uv[place, :count] = _as_shown(points, frame.mirror_px)[chosen]
        # Rounded, so that images of several sizes do not compile a program for each batch.
        return Observations(uv, None, K, T), float(np.round(np.mean(diagonals), -2))


@partial(jax.jit, static_argnames="noise")
def _closed_form(model: KeypointModel, observed: Observations, *, noise: KeypointNoise) -> AdamParameters:
    """Return where Adam begins: bones turned to the triangulated key points, and the mean shape."""
    points = triangulate_robust(observed, noise=noise, frame_axis=0)
    shape = jnp.zeros((len(observed.uv_px), NUM_SHAPES))
    pose, wrist = closed_form_pose(model, points.points, points.valid, shape)
    return AdamParameters(quaternion_from_rotation(rotation_from_axis_angle(pose)), shape, wrist)


def read_keypoints(path: str | Path) -> dict[str, Float[np.ndarray, "view 21 2"]]:
    """Read key points of a data set: an npz with `keys (n,)` and `keypoints_px (n, view, 21, 2)`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a field is missing or has another shape.
    """
    arrays = read_npz(path, required=["keys", "keypoints_px"])
    keys, points = arrays["keys"], arrays["keypoints_px"]
    if points.ndim != 4 or points.shape[-2:] != (NUM_JOINTS, 2) or keys.shape != points.shape[:1]:
        raise ValueError(
            f"{path}: `keypoints_px` must have shape (sample, view, 21, 2), with as many `keys (sample,)`; "
            f"got {points.shape} and {keys.shape}"
        )
    return {str(key): value for key, value in zip(keys, points.astype(np.float32), strict=True)}


def _as_shown(
    points_px: Float[np.ndarray, "view 21 2"], mirror_px: Float[np.ndarray, " view"] | None
) -> Float[np.ndarray, "view 21 2"]:
    """Mirror key points of a left hand's images as its frame is mirrored."""
    if mirror_px is None:
        return points_px
    return np.stack([2 * mirror_px[:, None] - points_px[..., 0], points_px[..., 1]], -1)
