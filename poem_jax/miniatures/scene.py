"""What a miniature shows, and the truth about it: a posed hand between cameras, in our own conventions.

Every writer of this room plants frames here and only then writes them down as its data set would. Truth is
float64; what a format rounds, the reader finds rounded. Pictures have the cameras' real sizes, but only the
part around the hand is rendered. Scenes are a pure function of their seed.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    invert_rigid,
    rotation_from_axis_angle,
    transform_points,
)
from poem_jax.hand.model import HandModel, hand_mesh, mirror_pose
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import FINGER_JOINTS, NUM_SHAPES, ROOT_JOINT, TIP_VERTICES_REGRESSED, WRIST
from poem_jax.synthetic.backgrounds import SIZE, make_backgrounds
from poem_jax.synthetic.config import (
    BodyConfig,
    CameraConfig,
    CropConfig,
    LightConfig,
    OccluderConfig,
    Range,
    SyntheticConfig,
)
from poem_jax.synthetic.dataset import Scene, render_view
from poem_jax.synthetic.poses import sample_pose
from poem_jax.synthetic.scene import (
    Body,
    PreparedHand,
    build_mesh,
    cast_shadows,
    draw_light,
    prepare_hand,
    random_rotation,
)
from poem_jax.synthetic.sensor import Exposure, warp_background
from poem_jax.synthetic.viewpoints import Viewpoints, draw_viewpoints
from poem_jax.typing import Array, Float, Int, UInt8

_BOX_OVER_HAND = 1.8
"""Side of the part that is rendered over that of the key points' box; holds most of the forearm."""
_TEXTURES = 4
_CONFIG = SyntheticConfig(
    supersample=1,
    body=BodyConfig(forearm_length_m=(0.04, 0.06)),
    occluders=OccluderConfig(held_probability=0.0, blocker_probability=0.0, stray_probability=0.0),
    light=LightConfig(),
)


class Rig(NamedTuple):
    """Calibrated cameras that look at the origin of their world, where hands are planted."""

    view_names: tuple[str, ...]
    size_wh: Int[Array, "view 2"]
    """Pixels."""
    K: Float[Array, "view 3 3"]
    """Pixels, the image spans [0, W] x [0, H]."""
    T_cam_from_world: Float[Array, "view 4 4"]


class PlantedFrame(NamedTuple):
    """The truth of one frame, float64: metres, OpenCV axes, the image spans [0, W] x [0, H]."""

    key_hint: str
    """Parts that the reader's key must contain."""
    view_names: tuple[str, ...]
    """Cameras, as the data set calls them, in the order in which the data set's frames list them."""
    size_wh: Int[Array, "view 2"]
    K: Float[Array, "view 3 3"]
    T_cam_from_world: Float[Array, "view 4 4"]
    joints_cam: Float[Array, "view 21 3"]
    vertices_cam: Float[Array, "view 778 3"]
    keypoints_px: Float[Array, "view 21 2"]
    pose_cam: Float[Array, "view 16 3"]
    """Axis-angle, MANO order, zero = flat hand; row 0 turns the hand into the camera's frame."""
    shape: Float[Array, "10"]
    images: tuple[UInt8[Array, "h w 3"], ...]
    """RGB, as the data set's file shows it, before encoding."""


def draw_rig(
    seed: int | Sequence[int],
    view_names: Sequence[str],
    size_wh: tuple[int, int] | Sequence[tuple[int, int]],
    *,
    distance_m: Range = (0.5, 0.9),
    field_of_view_deg: Range = (42.0, 56.0),
) -> Rig:
    """Draw cameras around the origin: fx and fy differ, principal points are off centre, rolls are small.

    Args:
        seed: of all chance; writers give tuples to tell sequences apart.
        view_names: one per camera.
        size_wh: one size for all cameras, or one each.
        distance_m: from the origin.
        field_of_view_deg: of the images' longer side.
    """
    views = len(view_names)
    sizes = np.broadcast_to(np.asarray(size_wh, np.int64), (views, 2)).copy()
    rng = np.random.default_rng((*_words(seed), 1))
    spots = 0.04 * rng.standard_normal((21, 3))
    drawn = []
    for size in sizes:
        config = CameraConfig(
            distance_m=distance_m,
            field_of_view_deg=field_of_view_deg,
            frames_wh=((int(size[0]), int(size[1])),),
            aim_jitter=0.15,
            principal_sigma=0.01,
            aspect_sigma=0.01,
            roll_deg=(-25.0, 25.0),
        )
        drawn.append(draw_viewpoints(config, CropConfig(), rng, spots - spots.mean(0), 1, (8, 8)))
    K = np.concatenate([one.K_frame for one in drawn])
    T = np.concatenate([one.T_cam_from_world for one in drawn])
    return Rig(tuple(view_names), sizes, K, T)


def plant(
    seed: int | Sequence[int],
    rig: Rig,
    hand: HandModel,
    *,
    key_hint: str,
    shape: Float[Array, "10"] | None = None,
    spread_m: float = 0.04,
) -> PlantedFrame:
    """Pose a hand near the origin of the rig's world and draw what every camera sees.

    Args:
        seed: of all chance; one each frame.
        rig: the cameras.
        hand: the model, of either side; a left hand gets a left hand's pose, and labels of a left hand
            (`mirrored` turns them).
        key_hint: see `PlantedFrame`.
        shape: shape coefficients; None draws them.
        spread_m: the hand's root joint lies within +- this of the origin, along each axis.
    """
    rng = np.random.default_rng((*_words(seed), 2))
    pose = sample_pose(rng, 1)[0]
    if bool(hand.is_left):
        pose = mirror_pose(pose)
    pose[WRIST] = axis_angle_from_rotation(random_rotation(rng))
    drawn_shape = rng.standard_normal(NUM_SHAPES)
    pose = pose.astype(np.float32).astype(np.float64)
    shape = np.asarray(drawn_shape if shape is None else shape, np.float32).astype(np.float64)
    place = rng.uniform(-spread_m, spread_m, 3)
    model = hand._replace(**{name: getattr(hand, name).astype(np.float64) for name in _FLOATS})
    mesh = hand_mesh(model, pose, shape, translation=place, center_joint=ROOT_JOINT)
    T = rig.T_cam_from_world
    pose_cam = np.repeat(pose[None], len(T), axis=0)
    pose_cam[:, WRIST] = axis_angle_from_rotation(T[:, :3, :3] @ rotation_from_axis_angle(pose[WRIST]))
    joints_cam = transform_points(T, mesh.joints[None])
    body = Body(
        pose.astype(np.float32),
        shape.astype(np.float32),
        mesh.vertices.astype(np.float32),
        mesh.joints.astype(np.float32),
    )
    keypoints_px = project_cam(rig.K, joints_cam)
    return PlantedFrame(
        key_hint,
        rig.view_names,
        rig.size_wh,
        rig.K,
        T,
        joints_cam,
        transform_points(T, mesh.vertices[None]),
        keypoints_px,
        pose_cam,
        shape,
        _pictures(rig, hand, body, keypoints_px, rng),
    )


def mano_translation(hand: HandModel, frame: PlantedFrame) -> Float[Array, "view 3"]:
    """Return what an uncentred MANO layer's output must be moved by, metres, in each camera's frame.

    The layer turns a hand about its resting wrist, so this is the wrist less the resting wrist.
    """
    rest = hand.J_regressor.astype(np.float64)[WRIST] @ (hand.v_template + hand.shapedirs @ frame.shape)
    return frame.joints_cam[:, WRIST] - rest


def index_origin(K: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Return intrinsics for pixels whose origin is the CENTRE of the first one, as OpenCV calibrates."""
    moved = np.array(K, np.float64)
    moved[..., :2, 2] -= 0.5
    return moved


def take_views(frame: PlantedFrame, views: Sequence[int]) -> PlantedFrame:
    """Return the frame with the chosen views, in the given order."""
    chosen = list(views)
    arrays = ("size_wh", "K", "T_cam_from_world", "joints_cam", "vertices_cam", "keypoints_px", "pose_cam")
    return frame._replace(
        view_names=tuple(frame.view_names[i] for i in chosen),
        images=tuple(frame.images[i] for i in chosen),
        **{name: getattr(frame, name)[chosen] for name in arrays},
    )


def anchored(frame: PlantedFrame, view: int) -> PlantedFrame:
    """Return the frame with the given camera as its world."""
    T = frame.T_cam_from_world
    T_cam_from_anchor = T @ invert_rigid(T[view])
    T_cam_from_anchor[view] = np.eye(4)
    return frame._replace(T_cam_from_world=T_cam_from_anchor)


def with_mesh_tips(frame: PlantedFrame) -> PlantedFrame:
    """Return the frame with its finger tips at the second set of tip vertices, key points likewise.

    HO-3D's and FreiHAND's joints are the posed skeleton with these (`smpl_handpca_wrapper_HAND_only.py`
    and `mano_utils.py` of their toolboxes), up to 8 mm from those of a MANO layer.
    """
    joints_cam = frame.joints_cam.copy()
    tips = [finger[-1] for finger in FINGER_JOINTS]
    joints_cam[:, tips] = frame.vertices_cam[:, list(TIP_VERTICES_REGRESSED)]
    return frame._replace(joints_cam=joints_cam, keypoints_px=project_cam(frame.K, joints_cam))


def mirrored(frame: PlantedFrame) -> PlantedFrame:
    """Return the labels of the other hand, as a mirror about each camera's u = cx shows it; images stay.

    Points x -> -x in every camera's frame, u -> 2 cx - u, T -> D T D with D = diag(-1, 1, 1).
    """
    flip = np.array([-1.0, 1.0, 1.0])
    both = np.diag([-1.0, 1.0, 1.0, 1.0])
    keypoints_px = frame.keypoints_px.copy()
    keypoints_px[..., 0] = 2 * frame.K[:, None, 0, 2] - keypoints_px[..., 0]
    return frame._replace(
        T_cam_from_world=both @ frame.T_cam_from_world @ both,
        joints_cam=frame.joints_cam * flip,
        vertices_cam=frame.vertices_cam * flip,
        keypoints_px=keypoints_px,
        pose_cam=mirror_pose(frame.pose_cam),
    )


_FLOATS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights")


def _words(seed: int | Sequence[int]) -> tuple[int, ...]:
    return (seed,) if isinstance(seed, int) else tuple(seed)


def _pictures(
    rig: Rig, hand: HandModel, body: Body, keypoints_px: Array, rng: np.random.Generator
) -> tuple[UInt8[Array, "h w 3"], ...]:
    """Draw what each camera sees: the texture everywhere, the hand and its forearm in a box."""
    prepared = _shipped() if hand is default_hand() else prepare_hand(hand)
    R, t = rig.T_cam_from_world[:, :3, :3], rig.T_cam_from_world[:, :3, 3]
    centers = -np.einsum("vji,vj->vi", R, t)
    boxes = np.stack([_box(*both) for both in zip(keypoints_px, rig.size_wh, strict=True)])
    K_box = rig.K.copy()
    K_box[:, :2, 2] -= boxes[:, :2]
    extent = np.concatenate([np.zeros_like(boxes[:, :2]), boxes[:, 2:] - boxes[:, :2]], axis=-1)
    points = Viewpoints(rig.K, rig.size_wh, rig.T_cam_from_world, centers, boxes, K_box, extent)
    light = draw_light(_CONFIG.light, rng)
    mesh = cast_shadows(build_mesh(prepared, body, centers, _CONFIG, rng), light)
    texture = _textures()[rng.integers(_TEXTURES)]
    scene = Scene(body, mesh, mesh.attributes(), light, points, [])
    return tuple(_picture(scene, view, texture) for view in range(len(boxes)))


@cache
def _shipped() -> PreparedHand:
    return prepare_hand(default_hand())


@cache
def _textures() -> UInt8[Array, "texture side side 3"]:
    return make_backgrounds(0, _TEXTURES)


def _picture(scene: Scene, view: int, texture: UInt8[Array, "side side 3"]) -> UInt8[Array, "h w 3"]:
    at = scene.viewpoints
    width, height = at.frame_wh[view].tolist()
    x0, y0, x1, y1 = at.box_px[view].astype(int).tolist()
    image = np.array(warp_background(texture, _exposure(width, height, 0, 0), (height, width))[0])
    if x1 - x0 < 2 or y1 - y0 < 2:
        return image
    image[y0:y1, x0:x1] = render_view(
        scene,
        K=at.K_crop[view],
        T_cam_from_world=at.T_cam_from_world[view],
        full_frame=at.frame_in_crop[view],
        exposure=_exposure(width, height, x0, y0),
        background=texture,
        hw=(y1 - y0, x1 - x0),
        scale=_CONFIG.supersample,
    ).image
    return image


def _box(keypoints_px: Float[Array, "21 2"], size_wh: Int[Array, "2"]) -> Float[Array, "4"]:
    """Return whole pixels around the hand, inside the image."""
    low, high = keypoints_px.min(0), keypoints_px.max(0)
    half = _BOX_OVER_HAND / 2 * (high - low).max()
    box = np.round([(low + high) / 2 - half, (low + high) / 2 + half])
    return np.clip(box, 0, size_wh).reshape(-1)


def _exposure(width: int, height: int, x0: int, y0: int) -> Exposure:
    """Return a plain camera's settings: the texture spans the image, and its bytes come out as they are."""
    scale = np.array([SIZE / width, SIZE / height])
    warp = np.array([[scale[0], 0, scale[0] * x0], [0, scale[1], scale[1] * y0]])
    return Exposure(
        gains=np.ones(3),
        gamma=0.5,
        blur_px=0.0,
        motion_px=0,
        motion_angle=0.0,
        noise=0.0,
        jpeg_quality=0,
        seed=0,
        background=0,
        warp=warp,
        background_gain=np.ones(3),
    )


def jpeg(image: UInt8[Array, "h w 3"], quality: int = 95) -> bytes:
    """Encode an RGB picture as JPEG."""
    return _encoded(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])


def png(image: UInt8[Array, "h w 3"]) -> bytes:
    """Encode an RGB picture as PNG, fast rather than small."""
    return _encoded(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _encoded(suffix: str, image: UInt8[Array, "h w 3"], options: list[int]) -> bytes:
    return cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1]), options)[1].tobytes()
