"""What a synthetic capture may look like: frozen ranges, nested by what they describe.

A `Range` (low, high) is drawn from uniformly. Lengths are metres, angles degrees (as photographers give
them), colours linear RGB in [0, 1].
"""

from dataclasses import dataclass, field
from typing import TypeAlias

Range: TypeAlias = tuple[float, float]


@dataclass(frozen=True)
class StandingCamera:
    """A camera of a rig, in its world: z up, metres."""

    place_m: tuple[float, float, float]
    looks_at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roll_deg: float = 0.0
    """About its axis; 0 = upright, and so many degrees turn the picture clockwise."""
    field_of_view_deg: float = 60.0
    """Of the frame's longer side."""
    frame_wh: tuple[int, int] = (640, 480)


@dataclass(frozen=True)
class CameraConfig:
    """Where cameras stand and what lenses they have; every view is drawn independently, unless a rig stands
    still and only the hand moves (`rig`; the other fields then say nothing)."""

    distance_m: Range = (0.3, 1.5)
    """From the camera to the hand; the direction is uniform on the sphere."""
    field_of_view_deg: Range = (35.0, 80.0)
    """Of the frame's longer side."""
    frames_wh: tuple[tuple[int, int], ...] = ((640, 480), (1280, 720), (1920, 1080), (1024, 1024))
    """Sizes of full frames; a crop shows black where its frame ends."""
    aim_jitter: float = 0.4
    """The hand is seen within this share of the frame's half size around the centre."""
    principal_sigma: float = 0.02
    """Spread of the principal point, as a share of the frame's longer side."""
    aspect_sigma: float = 0.005
    """Spread of fy / fx around 1."""
    roll_deg: Range = (-180.0, 180.0)
    rig: tuple[StandingCamera, ...] = ()
    """Cameras that stand still in the sample's world, in whose order views come; () = none do."""


@dataclass(frozen=True)
class CropConfig:
    """The square box around the 21 projected joints (reader's constants of POEM v2, but a tighter box)."""

    expand_ratio: float = 1.5
    """Box side over the longer side of the joints' bounding box."""
    center_jitter: float = 0.05
    """Spread of the box centre, as a share of the box side."""
    scale_jitter: float = 0.06
    """Spread of the box side, as a share of it."""


@dataclass(frozen=True)
class BodyConfig:
    """The hand's shape and place, and the forearm that keeps it from ending in the air."""

    shape_sigma: float = 1.0
    """Shape coefficients are normal with this spread."""
    world_offset_m: Range = (-1.0, 1.0)
    """Place of the root joint in the sample's world, along each axis."""
    forearm_length_m: Range = (0.10, 0.22)
    forearm_bend_deg: Range = (-40.0, 40.0)
    forearm_taper: Range = (1.05, 1.5)
    """Girth at the far end over girth at the wrist."""
    sleeve_probability: float = 0.4


@dataclass(frozen=True)
class OccluderConfig:
    """Objects in the scene; all views see all of them."""

    held_probability: float = 0.35
    """An object in the palm."""
    blocker_probability: float = 0.25
    """Per camera, whether an object stands between it and the hand."""
    blocker_gap_m: Range = (0.05, 0.16)
    """From the hand's centre towards the camera."""
    blocker_offset_sigma_m: float = 0.035
    stray_probability: float = 0.5
    """An object somewhere near the hand."""
    half_size_m: Range = (0.012, 0.045)
    """Along each axis of an object in the way or astray."""
    held_half_size_m: Range = (0.009, 0.032)
    """Across a held object; along the hand's width it is up to three times as long."""


@dataclass(frozen=True)
class LightConfig:
    """Directional lights, the first of which throws shadows, over light from the surroundings."""

    num_lights: tuple[int, int] = (1, 3)
    intensity: Range = (0.25, 1.1)
    ambient: Range = (0.12, 0.55)
    tint: float = 0.2
    """Largest departure of a light's colour from white, per channel."""


@dataclass(frozen=True)
class SensorConfig:
    """What a camera does to the light it receives; drawn per view."""

    gain: Range = (0.65, 1.6)
    gamma: Range = (0.36, 0.56)
    """Exponent from linear light to pixel values."""
    white_balance: float = 0.15
    """Largest departure of a channel's gain from 1."""
    blur_px: Range = (0.0, 1.3)
    """Standard deviation in crop pixels; below 0.3 nothing is blurred."""
    motion_probability: float = 0.15
    motion_px: tuple[int, int] = (2, 7)
    noise: Range = (0.0, 9.0)
    """Standard deviation in pixel values of 255."""
    jpeg_probability: float = 0.8
    jpeg_quality: tuple[int, int] = (35, 95)


@dataclass(frozen=True)
class SyntheticConfig:
    """A distribution of multi-view captures."""

    image_hw: tuple[int, int] = (128, 128)
    """Size of the crops."""
    num_views: int = 8
    """Cameras per sample; the first n of them are the same however many are asked for."""
    supersample: int = 2
    """Samples per pixel and axis of the rasteriser."""
    num_backgrounds: int = 64
    cameras: CameraConfig = field(default_factory=CameraConfig)
    crop: CropConfig = field(default_factory=CropConfig)
    body: BodyConfig = field(default_factory=BodyConfig)
    occluders: OccluderConfig = field(default_factory=OccluderConfig)
    light: LightConfig = field(default_factory=LightConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)

    def __post_init__(self) -> None:
        if min(self.image_hw) < 8 or self.num_views < 1 or self.supersample < 1 or self.num_backgrounds < 1:
            raise ValueError(
                "`image_hw` must be at least (8, 8), `num_views`, `supersample` and `num_backgrounds` at "
                f"least 1; got {self.image_hw}, {self.num_views}, {self.supersample}, {self.num_backgrounds}"
            )
