"""What a page shows: cameras, and frames with hands, pictures and what is known of them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from poem_jax.typing import Array, Float

HAND_RGB = {"right": (255, 120, 40), "left": (50, 130, 255)}


class PageCamera(NamedTuple):
    """An ideal pinhole camera with its principal point in the middle of its picture."""

    name: str
    T_cam_from_world: Float[Array, "4 4"]
    focal_px: float
    """Focal length in pixels of the pictures shown."""
    hw: tuple[int, int]
    """Size of the pictures shown."""


class PageHand(NamedTuple):
    """One hand at one moment; None, or NaN, where a number is not known."""

    vertices_world: Float[Array, "vert 3"]
    """Metres."""
    joints_world: Float[Array, "21 3"] | None = None
    """Metres, OpenPose order: where whoever gave the key points should see the joints."""
    keypoints_px: Float[Array, "view 21 2"] | None = None
    """Where the joints were seen, in pixels of the pictures shown."""
    error_px: Float[Array, "view 21"] | None = None
    """Distance of the projected joints to where they were seen, in pixels of the photographs."""
    sigma_m: Float[Array, "21"] | None = None
    """Standard deviation of one coordinate of each joint."""
    confidence: Float[Array, "view 21"] | None = None
    """How far each view bears each joint out, 0 to 1."""
    bridged: bool = False
    """Whether the hand was not seen, and stands between the moments before and after."""


class PageFrame(NamedTuple):
    """What one frame of a take shows."""

    name: str
    hands: Mapping[str, PageHand]
    """By a unique hand name that starts with its side; absent hands are left out."""
    pictures: Sequence[bytes | None]
    """One JPEG per camera (sizes as in its `PageCamera`), None where there is none; see `encode_picture`."""
    time_s: float | None = None
    """Seconds since the take began; None = not known."""


class Caption(NamedTuple):
    """What the page says of the take as a whole."""

    title: str
    subtitle: str = ""
    facts: Mapping[str, str] = {}
    """Numbers with their units by what they are, few and short: they stand beside the title."""
