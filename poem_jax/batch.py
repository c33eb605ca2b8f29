"""What goes into a model and what comes out: `MultiViewBatch` and `Prediction`, both pytrees of arrays."""

from typing import NamedTuple

from poem_jax.geometry.cameras import Cameras
from poem_jax.typing import Array, Bool, Float, Num


class MultiViewBatch(NamedTuple):
    """Calibrated views of one hand per sample, padded to a fixed number of views, with ground truth."""

    views: Num[Array, "batch view h w 3"]
    """RGB, uint8 or float in [0, 1]; padded views hold zeros."""
    cameras: Cameras
    """Intrinsics of the crops as fed, extrinsics from any world frame, and `view_mask`."""
    joints_world: Float[Array, "batch 21 3"]
    """Metres, OpenPose order."""
    vertices_world: Float[Array, "batch 778 3"]
    """Metres, MANO numbering."""
    keypoints_px: Float[Array, "batch view 21 2"]
    """Joints projected into each crop; zeros in padded views."""
    pose: Float[Array, "batch 16 3"] | None = None
    """Axis-angle, radians; `pose[:, 0]` turns the hand into the world frame."""
    shape: Float[Array, "batch 10"] | None = None
    root_world: Float[Array, "batch 3"] | None = None
    """Joint 9 (MCP of the middle finger) where it is known beforehand, else None."""
    sample_mask: Bool[Array, " batch"] | None = None
    """True = a real sample; False = padding of a last batch. None = all real."""


class Prediction(NamedTuple):
    """One hand per sample, in the world frame of the cameras that were given.

    What a system does not have is None: POEM (v1, v2) has a root and key points, but v1's ablation of one
    stage, PE-MeshTR, FTL-MeshTR and MvP have neither. `docs/models.md` says it for each.
    """

    vertices_world: Float[Array, "batch 778 3"]
    joints_world: Float[Array, "batch 21 3"]
    root_world: Float[Array, "batch 3"] | None
    """The point about which the second stage worked: triangulated, or as given."""
    keypoints_px: Float[Array, "batch view joint 2"] | None
    """Heat-map coordinates per view; one joint (the root) in POEM v2's paper, else 21."""
    layers_world: Float[Array, "batch layer 799 3"]
    """Query points after every layer that moves them, those of a joint decoder first, in the preset's own
    query order."""
    valid: Bool[Array, " batch"]
    """False where the sample could not be solved (no valid view; one view and no root, where the system
    triangulates; no basis point near the hand)."""
    heat_maps: Float[Array, "batch view joint h w"] | None = None
    """Where each view sees the joints of `keypoints_px`; every map sums to 1."""
    reference_joints_world: Float[Array, "batch 21 3"] | None = None
    """All triangulated joints, where the model has 21 heat maps."""
    reference_joints_mask: Bool[Array, "batch 21"] | None = None
    """False where a joint could not be triangulated: its rays do not meet before all cameras that see it.
    None, too, where the model has no such joints."""
    pose: Float[Array, "batch 16 3"] | None = None
    """Axis-angle of parametric models, `pose[:, 0]` in the user's world; compare as rotations."""
    shape: Float[Array, "batch 10"] | None = None
    translation: Float[Array, "batch 3"] | None = None
