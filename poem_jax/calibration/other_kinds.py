"""Files that are known and cannot be read as a rig, with what to do: single lenses, and closed formats."""

from collections.abc import Callable
from typing import NamedTuple

from poem_jax.calibration.documents import Document, Syntax


class OtherKind(NamedTuple):
    """A kind of file that holds no rig, or none that can be known from public facts."""

    name: str
    recognise: Callable[[Document], bool]
    advice: str


def _has(syntax: tuple[Syntax, ...], *keys: str) -> Callable[[Document], bool]:
    return lambda document: document.syntax in syntax and document.keys >= set(keys)


_YAMLS = (Syntax.YAML, Syntax.OPENCV_YAML)
OTHER_KINDS = (
    OtherKind(
        "a ROS camera_info",
        _has(_YAMLS, "camera_matrix", "distortion_coefficients", "distortion_model"),
        "it holds the lens of one camera alone, and a rig needs where each stands, too: put its numbers as "
        "`K` and `dist` into a rig.json, with `R` and `t` of an extrinsic calibration (Kalibr's "
        "camchain.yaml has both)",
    ),
    OtherKind(
        "Vicon's XCP",
        _has((Syntax.XML,), "KeyFrame", "ORIENTATION", "PRINCIPAL_POINT"),
        "its public readers differ in which way its images are turned, so that it is not read; write the "
        "cameras as rig.json, or convert it with Pose2Sim, whose TOML is read",
    ),
    OtherKind(
        "Qualisys's calibration",
        _has((Syntax.XML,), "fov_video", "intrinsic"),
        "its terms of the lens are not publicly described, so that it is not read; convert it with Pose2Sim, "
        "whose TOML is read, and check the result",
    ),
    OtherKind(
        "the configuration of an anipose project",
        _has((Syntax.TOML,), "cam_regex"),
        "the cameras stand in its calibration.toml",
    ),
)
