"""What the page shows of a frame: hands, small pictures, and how far each view bears each joint out."""

from collections.abc import Iterable, Sequence

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.report import Report
from poem_jax.capture.take import Take
from poem_jax.data.lens import PictureMap, project_raw, take_picture
from poem_jax.geometry.cameras import invert_intrinsics, transform_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT
from poem_jax.typing import Array, Float
from poem_jax.viz.page import PageCamera, PageFrame, PageHand, encode_picture


def page_frame(
    frame: Frame, take: Take, cameras: Sequence[PageCamera], maps: Sequence[PictureMap]
) -> PageFrame:
    """Make a frame of the page: its hands by name, and small pictures without distortion.

    Args:
        frame: Judged, with its photographs.
        take: The capture.
        cameras, maps: The page's cameras at the places of the rig's, and where their pictures' pixels lie in
            the photographs.
    """
    hands = {
        name: _page_hand(hand, _seen_px(frame, index), take.rig, cameras)
        for index, (name, hand) in enumerate(zip(take.hand_names, frame.hands, strict=True))
        if hand.vertices_world is not None
    }
    views = zip(frame.images, maps, strict=True)
    pictures = [None if image is None else encode_picture(take_picture(image, at)) for image, at in views]
    return PageFrame(frame.name, hands, pictures, frame.time_s)


def page_facts(report: Report, frames: Iterable[PageFrame]) -> dict[str, str]:
    """Return the few numbers of a take that stand at the head of its page.

    Args:
        report: Of the whole take.
        frames: The page's, of which the standard deviations are taken.
    """
    facts = {
        "frames": f"{report.frames}",
        "hands solved": f"{report.solved} of {report.hands}",
        "cameras": f"{report.num_cameras}",
    }
    error_px = report.reprojection()["median_px"]
    if error_px is not None:
        facts["median reprojection"] = f"{error_px:.1f} px"
    sigmas = [hand.sigma_m for frame in frames for hand in frame.hands.values() if hand.sigma_m is not None]
    if sigmas and np.isfinite(sigmas).any():
        facts["median sigma"] = f"{1000 * np.nanmedian(sigmas):.1f} mm"
    return facts


def _seen_px(frame: Frame, index: int) -> Float[Array, "view 21 2"] | None:
    """Return where a hand's joints were seen in the photographs: as given, else by a network's heat maps;
    None of a bridged hand, which was not seen."""
    if frame.hands[index].bridged:
        return None
    if frame.keypoints_px is not None:
        return frame.keypoints_px[index]
    by_network = frame.hands[index].keypoints_px
    if by_network is None or by_network.shape[-2] == NUM_JOINTS:
        return by_network
    seen = np.full((len(by_network), NUM_JOINTS, 2), np.nan)
    seen[:, ROOT_JOINT] = by_network[:, 0]
    return seen


def _page_hand(
    hand: HandResult,
    seen_px: Float[Array, "view 21 2"] | None,
    rig: Rig,
    cameras: Sequence[PageCamera],
) -> PageHand:
    assert hand.vertices_world is not None
    assert hand.joints_world is not None
    expected = hand.joints_world if hand.expected_world is None else hand.expected_world
    return PageHand(
        hand.vertices_world,
        expected,
        None if seen_px is None else _in_pictures(seen_px, rig, cameras),
        None if seen_px is None else joint_errors_px(expected, seen_px, rig),
        hand.joint_sigma_m,
        hand.joint_confidence,
        hand.bridged,
    )


def joint_errors_px(
    joints_world: Float[Array, "21 3"], seen_px: Float[Array, "view 21 2"], rig: Rig
) -> Float[Array, "view 21"]:
    """Return the distance of every projected joint to where it was seen, in raw pixels; NaN = not seen."""
    projected = np.stack([project_raw(rig, view, joints_world)[0] for view in range(rig.num_views)])
    return np.linalg.norm(projected - seen_px, axis=-1)


def _in_pictures(
    seen_px: Float[Array, "view 21 2"], rig: Rig, cameras: Sequence[PageCamera]
) -> Float[Array, "view 21 2"]:
    """Move points from the raw photographs to the page's pictures; NaN stays."""
    ideal_px = ideal_keypoints(rig, np.asarray(seen_px, np.float64)[None, None])[0, 0]
    return np.stack([_moved(ideal_px[view], rig, view, camera) for view, camera in enumerate(cameras)])


def _moved(ideal_px: Float[Array, "21 2"], rig: Rig, view: int, camera: PageCamera) -> Float[Array, "21 2"]:
    height, width = camera.hw
    K_picture = np.array([[camera.focal_px, 0, width / 2], [0, camera.focal_px, height / 2], [0, 0, 1]])
    R_picture_from_cam = camera.T_cam_from_world[:3, :3] @ rig.T_cam_from_world[view, :3, :3].T
    return transform_pixels(K_picture @ R_picture_from_cam @ invert_intrinsics(rig.K[view]), ideal_px)
