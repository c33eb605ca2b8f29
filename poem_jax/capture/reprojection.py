"""How well a reconstruction agrees with what the images say: distances in raw pixels, view by view."""

from typing import NamedTuple

import numpy as np

from poem_jax.capture.lens import project_raw
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Bool, Float


class Evidence(NamedTuple):
    """2D points of a hand in the raw photographs."""

    points_px: Float[Array, "view joint 2"]
    """NaN = unseen."""
    joints: tuple[int, ...]
    """Which of the 21 joints they are."""


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
    joints_world: Float[Array, "21 3"], evidence: Evidence, rig: Rig
) -> Float[Array, " view"]:
    """Return the mean distance in raw pixels per view between the evidence and the projected joints.

    Views without evidence hold NaN.
    """
    errors = np.full(len(rig.names), np.nan)
    for view in np.flatnonzero(np.isfinite(evidence.points_px).all(-1).any(-1)):
        projected, _ = project_raw(rig, int(view), joints_world[list(evidence.joints)])
        distances = np.linalg.norm(projected - evidence.points_px[view], axis=-1)
        seen = np.isfinite(distances)
        if seen.any():
            errors[view] = distances[seen].mean()
    return errors
