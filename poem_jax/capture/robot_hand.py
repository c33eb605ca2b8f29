"""Joint angles of a robot hand whose finger tips follow a reconstructed hand, by dex-retargeting (an extra).

dex-retargeting looks for the angles that bring vectors between links of the robot nearest to those between
joints of the person, scaled (Qin et al., AnyTeleop, 2023). The vectors taken here run from the middle knuckle
to the tips; the scale makes the person's fingers as long as the robot's.
"""

import importlib.metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.capture.robot_frame import joints_in_palm_frame
from poem_jax.hand.bones import bone_lengths
from poem_jax.hand.topology import BONES, FINGER_JOINTS, ROOT_JOINT
from poem_jax.typing import Array, Bool, Float

_TIPS = tuple(finger[-1] for finger in FINGER_JOINTS[:4])
"""Key points: tips of thumb, index, middle and ring finger."""
_MIDDLE_FINGER = [index for index, (_, end) in enumerate(BONES) if end in FINGER_JOINTS[2][1:]]
HOW_TO_INSTALL = "pip install 'poem-jax[retarget]'"


class RobotHand(NamedTuple):
    """What is to be known of a robot beyond its URDF."""

    name: str
    side: str
    urdf: str
    """Where it ends in the package `example-robot-data`."""
    knuckle: str
    """The link that stands for the middle knuckle."""
    tips: tuple[str, str, str, str]
    """Links of the tips of thumb, index, middle and ring finger."""
    finger_m: float
    """From a knuckle to the tip of a straight finger."""


ALLEGRO = RobotHand(
    name="allegro",
    side="right",
    urdf="allegro_hand_description/urdf/allegro_right_hand.urdf",
    knuckle="link_5.0",
    tips=("link_15.0_tip", "link_3.0_tip", "link_7.0_tip", "link_11.0_tip"),
    finger_m=0.1191,
)


class RobotMotion(NamedTuple):
    """A robot hand through a take."""

    joint_names: list[str]
    angles: Float[np.ndarray, "frame dof"]
    """Radians; NaN where the hand was not seen."""


def follow(
    robot: RobotHand, urdf: Path, joints_world: Float[Array, "frame 21 3"], valid: Bool[Array, " frame"]
) -> RobotMotion:
    """Return the angles by which a robot hand follows a person's.

    Args:
        robot: Which.
        urdf: Its description; the meshes that it names are not needed.
        joints_world: Of a hand of the robot's side, metres; NaN where not `valid`.
        valid: Frames with a hand; one at least.

    Raises:
        ModuleNotFoundError: The extra is not installed; how to.
        FileNotFoundError: No such URDF.
        ValueError: The URDF lacks a link that is needed.
    """
    joints = joints_in_palm_frame(np.asarray(joints_world)[valid], side=robot.side)
    finger_m = float(np.median(bone_lengths(joints)[:, _MIDDLE_FINGER].sum(-1)))
    solver = _solver(robot, urdf, robot.finger_m / finger_m)
    vectors = joints[:, _TIPS] - joints[:, ROOT_JOINT : ROOT_JOINT + 1]
    found = np.stack([np.asarray(solver.retarget(frame)) for frame in vectors])
    angles = np.full((len(valid), found.shape[1]), np.nan)
    angles[valid] = found
    return RobotMotion(list(solver.joint_names), angles)


def packaged_urdf(robot: RobotHand) -> Path:
    """Return the robot's URDF in the package `example-robot-data`.

    Raises: ModuleNotFoundError, FileNotFoundError: The package, or the file in it, is not there.
    """
    try:
        files = importlib.metadata.files("example-robot-data") or []
    except importlib.metadata.PackageNotFoundError as error:
        raise ModuleNotFoundError(
            f"the URDF of {robot.name} comes with example-robot-data: {HOW_TO_INSTALL}; or give --urdf FILE"
        ) from error
    found = [file for file in files if file.as_posix().endswith(robot.urdf)]
    if not found:
        raise FileNotFoundError(f"example-robot-data holds no {robot.urdf}; give the robot's by --urdf")
    return Path(str(found[0].locate()))


def _solver(robot: RobotHand, urdf: Path, scale: float) -> Any:
    if not urdf.is_file():
        raise FileNotFoundError(f"no URDF at {urdf}; give the robot's by --urdf")
    try:
        from dex_retargeting.retargeting_config import RetargetingConfig  # pyright: ignore
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"robot hands need dex-retargeting ({error}): {HOW_TO_INSTALL}") from error
    config = RetargetingConfig(
        type="vector",
        urdf_path=str(urdf.resolve()),
        target_origin_link_names=[robot.knuckle] * len(_TIPS),
        target_task_link_names=list(robot.tips),
        target_link_human_indices=np.array([[ROOT_JOINT] * len(_TIPS), _TIPS]),
        scaling_factor=scale,
        low_pass_alpha=1.0,
    )
    return config.build()
