"""How well a reconstruction agrees with what the images say: distances in raw pixels, view by view."""

from typing import Any, NamedTuple

import numpy as np

from poem_jax.capture.boxes_file import HandBoxes
from poem_jax.capture.lens import project_raw
from poem_jax.capture.samples import HandResult, HandSample
from poem_jax.geometry.cameras import normalised_from_pixels, pixels_from_normalised
from poem_jax.geometry.distortion import distort
from poem_jax.geometry.rig import Rig
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT
from poem_jax.typing import Array, Bool, Float


class Evidence(NamedTuple):
    """2D points of a hand in the raw photographs."""

    points_px: Float[Array, "view joint 2"]
    """NaN = unseen."""
    joints: tuple[int, ...]
    """Which of the 21 joints they are."""


def given_evidence(hands: HandBoxes, frame: int, hand: int) -> Evidence:
    """Return the key points that came with the capture.

    Raises:
        ValueError: The capture came with boxes only.
    """
    if hands.keypoints_px is None:
        raise ValueError("the capture has boxes but no key points")
    return Evidence(hands.keypoints_px[frame, hand], tuple(range(NUM_JOINTS)))


def model_evidence(result: HandResult, sample: HandSample, rig: Rig) -> Evidence:
    """Return the model's own heat-map points, moved from its crops to the raw photographs.

    Args:
        result: In the capture's world, its crops unflipped.
        sample: The crops before any mirroring.
        rig: The cameras.

    Raises: ValueError: The result does not come from a network.
    """
    if result.keypoints_px is None:
        raise ValueError("the result holds no heat-map points")
    rays = normalised_from_pixels(sample.K.astype(np.float64), result.keypoints_px.astype(np.float64))
    raw = pixels_from_normalised(rig.K, distort(rays, rig.dist))
    joints = (ROOT_JOINT,) if raw.shape[-2] == 1 else tuple(range(NUM_JOINTS))
    return Evidence(np.where(sample.view_mask[:, None, None], raw, np.nan), joints)


def joints_shown(
    joints_world: Float[Array, "21 3"], view_mask: Bool[Array, " view"], rig: Rig
) -> Float[Array, " view"]:
    """Return the share of the joints that the lens of each view shows, in or beside its image.

    The others, behind the camera or beyond the fold of the lens, have no reprojection error. Masked views
    hold NaN.
    """
    shares = np.full(len(rig.names), np.nan)
    for view in np.flatnonzero(view_mask):
        shares[view] = np.isfinite(project_raw(rig, int(view), joints_world)[0]).all(-1).mean()
    return shares


def reprojection_error(
    joints_world: Float[Array, "21 3"], evidence: Evidence, view_mask: Bool[Array, " view"], rig: Rig
) -> Float[Array, " view"]:
    """Return the mean distance in raw pixels per view between the evidence and the projected joints.

    Views that are masked, or without evidence, hold NaN.
    """
    errors = np.full(len(rig.names), np.nan)
    for view in np.flatnonzero(view_mask):
        projected, _ = project_raw(rig, int(view), joints_world[list(evidence.joints)])
        distances = np.linalg.norm(projected - evidence.points_px[view], axis=-1)
        seen = np.isfinite(distances)
        if seen.any():
            errors[view] = distances[seen].mean()
    return errors


def error_summary(
    errors_px: Float[Array, "frame hand view"], views_used: Bool[Array, "frame hand view"], hands: HandBoxes
) -> dict[str, Any]:
    """Say in plain types how large the errors of a take are, and against what they were measured."""
    seen = errors_px[np.isfinite(errors_px)]
    against = "the model's own heat maps" if hands.keypoints_px is None else "the key points given"
    return {
        "against": against,
        "mean_px": float(seen.mean()) if seen.size else None,
        "median_px": float(np.median(seen)) if seen.size else None,
        "views_used": int(views_used.sum()),
    }
