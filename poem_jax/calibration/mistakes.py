"""The mistakes that people make with a whole rig or all its key points, and how each is undone.

Every one of them is known by name and has nothing to be estimated. `hypotheses.py` tries them on all cameras,
`one_camera.py` on the one that stands alone.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.geometry.transforms import invert_rigid, rigid
from poem_jax.typing import Array


class Hypothesis(NamedTuple):
    """A mistake that people make, and how it is undone."""

    name: str
    cause: str
    """What the user did, as the end of "...: it seems that"."""
    fix: str
    undo: Callable[[Rig, Array], tuple[Rig, Array]]
    """(rig, raw key points) as given -> as they should be."""


def _extrinsics(change: Callable[[Array], Array]) -> Callable[[Rig, Array], tuple[Rig, Array]]:
    return lambda rig, uv: (
        rig._replace(T_cam_from_world=change(np.asarray(rig.T_cam_from_world, np.float64))),
        uv,
    )


def _pixels(change: Callable[[Array, Array], Array]) -> Callable[[Rig, Array], tuple[Rig, Array]]:
    """Change key points, as the file counts them, given the sizes (view, 1, 2) of the images."""
    return lambda rig, uv: (rig, change(uv - HALF_PIXEL, rig.size_wh[:, None]) + HALF_PIXEL)


def _intrinsics(change: Callable[[Array], Array]) -> Callable[[Rig, Array], tuple[Rig, Array]]:
    return lambda rig, uv: (rig._replace(K=change(np.array(rig.K, np.float64))), uv)


def _focal_lengths_exchanged(K: Array) -> Array:
    K[:, 0, 0], K[:, 1, 1] = K[:, 1, 1].copy(), K[:, 0, 0].copy()
    return K


def _centre_exchanged(K: Array) -> Array:
    K[:, 0, 2], K[:, 1, 2] = K[:, 1, 2].copy(), K[:, 0, 2].copy()
    return K


def _then(change: Callable[[Array], Array], signs: tuple[int, int, int]) -> Callable[[Array], Array]:
    """Change extrinsics, then turn the cameras' axes."""
    return lambda T: np.diag([*signs, 1.0]) @ change(T)


def _same(T: Array) -> Array:
    return T


def _centres(T: Array) -> Array:
    """Return the extrinsics whose `t` was given as the cameras' centres."""
    R = T[:, :3, :3]
    return rigid(R, -np.einsum("vij,vj->vi", R, T[:, :3, 3]))


_TO_WORLD = "`R` and `t` map camera points to world points"
_INVERSE = "write the inverses: R^T and -R^T t"
_AXES = {
    "OpenGL or Blender axes (y up, z backward)": (1, -1, -1),
    "axes with x left and y up, as PyTorch3D's": (-1, -1, 1),
    "axes with x left and z backward": (-1, 1, -1),
}
HYPOTHESES: tuple[Hypothesis, ...] = (
    Hypothesis("inverted extrinsics", _TO_WORLD, _INVERSE, _extrinsics(invert_rigid)),
    Hypothesis(
        "centres as t",
        "`t` holds the cameras' centres in the world",
        "write t = -R @ centre",
        _extrinsics(_centres),
    ),
    Hypothesis(
        "transposed R",
        "`R` is transposed, while `t` is right",
        "transpose every `R`",
        _extrinsics(lambda T: rigid(np.swapaxes(T[:, :3, :3], -1, -2), T[:, :3, 3])),
    ),
    Hypothesis(
        "negated t",
        "`t` has the wrong sign",
        "negate every `t`",
        _extrinsics(lambda T: rigid(T[:, :3, :3], -T[:, :3, 3])),
    ),
    *(
        Hypothesis(
            "camera axes",
            f"the cameras have {axes}, not OpenCV's",
            f"multiply `R` and `t` from the left by diag{signs}",
            _extrinsics(_then(_same, signs)),
        )
        for axes, signs in _AXES.items()
    ),
    *(
        Hypothesis(
            "camera axes, inverted extrinsics",
            f"{_TO_WORLD}, and the cameras have {axes}, not OpenCV's",
            f"{_INVERSE}; then multiply both from the left by diag{signs}",
            _extrinsics(_then(invert_rigid, signs)),
        )
        for axes, signs in _AXES.items()
    ),
    *(
        Hypothesis(
            "camera axes, centres as t",
            f"`t` holds the cameras' centres in the world, and the cameras have {axes}, not OpenCV's",
            f"write t = -R @ centre; then multiply both from the left by diag{signs}",
            _extrinsics(_then(_centres, signs)),
        )
        for axes, signs in _AXES.items()
    ),
    Hypothesis(
        "normalised pixels",
        "the key points are shares of the images' width and height, not pixels",
        "multiply x by the width and y by the height",
        _pixels(lambda uv, wh: uv * wh - HALF_PIXEL),
    ),
    Hypothesis(
        "normalised pixels from -1 to 1",
        "the key points run from -1 to 1 over the images, not in pixels",
        "write (x + 1) / 2 times the width, and (y + 1) / 2 times the height",
        _pixels(lambda uv, wh: (uv + 1) / 2 * wh - HALF_PIXEL),
    ),
    Hypothesis(
        "row before column",
        "the key points are given as (y, x)",
        "write x, the column, first",
        _pixels(lambda uv, _: uv[..., ::-1]),
    ),
    Hypothesis(
        "y upwards",
        "y of the key points counts from the images' lower edge",
        "write height - 1 - y",
        _pixels(lambda uv, wh: np.stack([uv[..., 0], wh[..., 1] - 1 - uv[..., 1]], -1)),
    ),
    Hypothesis(
        "mirrored pixels",
        "all images, or their key points, are mirrored left to right",
        "use the images as calibrated; or write width - 1 - x, and exchange left and right",
        _pixels(lambda uv, wh: np.stack([wh[..., 0] - 1 - uv[..., 0], uv[..., 1]], -1)),
    ),
    Hypothesis(
        "focal lengths exchanged",
        "fx and fy are exchanged",
        "exchange K[0][0] and K[1][1]",
        _intrinsics(_focal_lengths_exchanged),
    ),
    Hypothesis(
        "principal point exchanged",
        "cx and cy are exchanged",
        "exchange K[0][2] and K[1][2]",
        _intrinsics(_centre_exchanged),
    ),
    *(
        Hypothesis(
            "pixels of another resolution",
            f"the key points are of images {1 / factor:.3g} times as large as the rig's",
            f"multiply them by {factor:.3g}, or scale `K`, width and height",
            _pixels(lambda uv, _, factor=factor: (uv + HALF_PIXEL) * factor - HALF_PIXEL),
        )
        for factor in (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 2, 2, 3, 4)
    ),
)
"""The mistakes that are tried. Orders of joints and the unit are judged beside each of them."""
