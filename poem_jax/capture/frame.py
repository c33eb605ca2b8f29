"""One moment of a capture, and what came of each hand in it: what flows through the line.

Every stage takes a stream of frames and gives one on, with its own fields filled in. What a later stage does
not need is dropped on the way, so that memory does not grow with the take.
"""

from typing import NamedTuple

from poem_jax.io.video import ImageSource
from poem_jax.typing import Array, Bool, Float, UInt8


class ImageProblem(NamedTuple):
    """An image that is missing or cannot be used; its view is masked."""

    needed: bool
    """Whether a hand was to be found in it."""
    error: FileNotFoundError | ValueError


class HandCrops(NamedTuple):
    """One hand as a model is fed; masked views hold zeros and identity matrices."""

    views: UInt8[Array, "view h w 3"]
    K: Float[Array, "view 3 3"]
    """Of the crops, which have no distortion."""
    T_cam_from_world: Float[Array, "view 4 4"]
    view_mask: Bool[Array, " view"]


class HandResult(NamedTuple):
    """What came of one hand in one frame. Metres, in the capture's world; None = not there (yet)."""

    view_mask: Bool[Array, " view"]
    """Views that were used."""
    reason: str | None = None
    """Why the hand was not reconstructed; None if it was."""
    vertices_world: Float[Array, "778 3"] | None = None
    joints_world: Float[Array, "21 3"] | None = None
    root_world: Float[Array, "3"] | None = None
    pose: Float[Array, "16 3"] | None = None
    """Axis-angle, radians, where the engine has a parametric hand."""
    shape: Float[Array, "10"] | None = None
    translation: Float[Array, "3"] | None = None
    expected_world: Float[Array, "21 3"] | None = None
    """Where the detector of the key points should see the joints; None = at `joints_world`."""
    joint_sigma_m: Float[Array, "21"] | None = None
    """Standard deviation of one coordinate of each joint, where the engine knows it."""
    keypoints_px: Float[Array, "view joint 2"] | None = None
    """Where a network's heat maps see the joints (the root alone, or all 21), if it has any: pixels of the
    photographs."""
    reprojection_px: Float[Array, " view"] | None = None
    """Mean distance of the projected joints to the 2D evidence in each photograph; NaN = none there."""
    joints_shown: Float[Array, " view"] | None = None
    """Share of the joints that the view's lens shows; NaN = view not used."""
    joint_confidence: Float[Array, "view 21"] | None = None
    """How far each view's picture of each joint bears the result out, 0 to 1; NaN = not seen there."""
    alone_world: Float[Array, "21 3"] | None = None
    """The joints as this moment alone shows them; None = as `joints_world`."""
    bridged: bool = False
    """Whether the hand was not seen at this moment, and stands between those before and after it."""


def too_few_views(seen: int, needed: int) -> str:
    """Return the reason of a hand that not enough views see: one, or two, are needed."""
    return f"seen in {seen} view(s); {'two are' if needed == 2 else 'one is'} needed"


class Frame(NamedTuple):
    """One moment. Hands are in the order of the take's sides, views in the order of the rig."""

    name: str
    """Serves as the name of a folder."""
    boxes_px: Float[Array, "hand view 4"]
    """x0 y0 x1 y1 in the photographs, tight about the joints; NaN = unseen."""
    keypoints_px: Float[Array, "hand view 21 2"] | None = None
    """In the photographs; NaN = unseen; None where the capture comes with boxes alone."""
    confidence: Float[Array, "hand view 21"] | None = None
    image_files: tuple[ImageSource | None, ...] = ()
    """One per view, a file or a frame of a video; None = there is none."""
    squares_px: Float[Array, "hand view 4"] | None = None
    """The square about each hand, in pixels without distortion; NaN = unseen."""
    images: tuple[UInt8[Array, "h w 3"] | None, ...] = ()
    """RGB photographs, as far as they can be read."""
    problems: tuple[ImageProblem, ...] = ()
    crops: tuple[HandCrops | None, ...] = ()
    """One per hand; None where there is a reason against it."""
    hands: tuple[HandResult, ...] = ()
    time_s: float | None = None
    """Seconds since the take began, by the cameras' common clock; None = only the order is known."""
    warnings: tuple[str, ...] = ()
    """What was noticed at this frame and is true of more than it."""
