"""Faults that people make with calibrations and key points, planted into good ones."""

import numpy as np

from poem_jax.geometry.distortion import undistort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle
from poem_jax.hand.joint_orders import JOINT_ORDERS

OPENGL = np.diag([1.0, -1, -1, 1])


def _extrinsics(change):
    return lambda rig, uv: (rig._replace(T_cam_from_world=change(rig.T_cam_from_world.copy())), uv)


def _pixels(change):
    return lambda rig, uv: (rig, change(uv.copy(), rig.size_wh[:, None].astype(float)))


def _unit(factor):
    def change(T):
        T[:, :3, 3] *= factor
        return T

    return _extrinsics(change)


def _centres(T):
    return np.concatenate([T[:, :, :3], invert_rigid(T)[:, :, 3:]], -1)


def _transposed(T):
    return rigid(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3])


def _one(view, turn_deg=0.0, move=(0.0, 0.0, 0.0)):
    def change(T):
        R = rotation_from_axis_angle(np.radians(turn_deg) * np.array([0.6, -0.64, 0.48]))
        T[view] = rigid(R, np.array(move)) @ T[view]
        return T

    return _extrinsics(change)


def _mirror(views):
    def change(uv, wh):
        uv[:, :, views, :, 0] = wh[views, :, 0] - uv[:, :, views, :, 0]
        return uv

    return _pixels(change)


def _turned_image(view):
    def change(uv, wh):
        uv[:, :, view] = wh[view] - uv[:, :, view]
        return uv

    return _pixels(change)


def _K(view, factor):
    def plant(rig, uv):
        K = rig.K.copy()
        K[view, :2] *= factor
        return rig._replace(K=K), uv

    return plant


def _exchange(what, views):
    def plant(rig, uv):
        K = rig.K.copy()
        for view in range(rig.num_views) if views is None else views:
            a, b = (((0, 0), (1, 1)), ((0, 2), (1, 2)))[what == "centre"]
            K[view][a], K[view][b] = K[view][b], K[view][a]
        return rig._replace(K=K), uv

    return plant


def _swapped(rig, uv):
    return rig, uv[:, :, [1, 0, *range(2, rig.num_views)]]


def _duplicate(rig, uv):
    T = rig.T_cam_from_world.copy()
    T[1] = T[0]
    return rig._replace(T_cam_from_world=T), uv


def _copied(rig, uv):
    uv = uv.copy()
    uv[:, :, 1] = uv[:, :, 0]
    return rig, uv


def _undistorted(rig, uv):
    flat = np.moveaxis(uv, 2, 0).reshape(rig.num_views, -1, 2)
    ideal = undistort_pixels(flat, rig.K, rig.dist)
    return rig, np.moveaxis(ideal.reshape(np.moveaxis(uv, 2, 0).shape), 0, 2)


def late(frames, view=2):
    """One camera's frames are so many frames late: each shows what was to be seen before (whole frames)."""

    def plant(rig, uv):
        moved = np.full_like(uv[:, :, view], np.nan)
        if frames > 0:
            moved[:-frames] = uv[frames:, :, view]
        else:
            moved[-frames:] = uv[:frames, :, view]
        uv = uv.copy()
        uv[:, :, view] = moved
        return rig, uv

    return plant


def _order(rig, uv):
    return rig, uv[..., np.argsort(next(iter(JOINT_ORDERS.values()))), :]


FAULTS = {
    "inverted extrinsics": (_extrinsics(invert_rigid), "inverted extrinsics", "write the inverses"),
    "centres as t": (_extrinsics(_centres), "centres as t", "t = -R @ centre"),
    "transposed R": (_extrinsics(_transposed), "transposed R", "transpose every `R`"),
    "negated t": (_unit(-1), "negated t", "negate every `t`"),
    "millimetres": (_unit(1e3), "unit of the rig", "millimetres"),
    "centimetres": (_unit(1e2), "unit of the rig", "centimetres"),
    "inches": (_unit(1 / 0.0254), "unit of the rig", "inches"),
    "OpenGL axes": (_extrinsics(lambda T: OPENGL @ T), "camera axes", "OpenGL"),
    "OpenGL axes, to world": (
        _extrinsics(lambda T: invert_rigid(OPENGL @ T)),
        "camera axes, inverted extrinsics",
        "OpenGL",
    ),
    "all images mirrored": (_mirror(slice(None)), "mirrored pixels", "mirrored left to right"),
    "one image mirrored": (_mirror([1]), "flipped image", "'{1}' seems to be mirrored left to right"),
    "one image turned": (_turned_image(1), "flipped image", "'{1}' seems to be turned by 180"),
    "pixels of half the size": (
        _pixels(lambda uv, _: uv / 2),
        "pixels of another resolution",
        "0.5 times as large",
    ),
    "K of half the size": (_K(slice(None), 0.5), "pixels of another resolution", "2 times as large"),
    "K of one camera of half the size": (_K(1, 0.5), "pixels of another resolution", "camera '{1}' alone"),
    "cx and cy exchanged": (_exchange("centre", None), "principal point exchanged", "cx and cy"),
    "cx and cy of one camera exchanged": (
        _exchange("centre", [3]),
        "principal point exchanged",
        "'{3}' alone",
    ),
    "cameras swapped": (_swapped, "cameras exchanged", "'{0}' is of '{1}'"),
    "duplicate cameras": (_duplicate, "duplicate cameras", "'{0}' and '{1}'"),
    "one image copied": (_copied, "copied images", "'{0}' and '{1}'"),
    "one camera turned": (_one(2, turn_deg=6), "camera moved", "camera '{2}' alone"),
    "one camera moved": (_one(1, move=(0.15, -0.1, 0.1)), "camera moved", "camera '{1}' alone"),
    "another order of joints": (_order, "joint order", "MANO's"),
    "normalised pixels": (_pixels(lambda uv, wh: uv / wh + 0.5), "normalised pixels", "shares of"),
    "pixels from -1 to 1": (
        _pixels(lambda uv, wh: 2 * uv / wh - 0.5),
        "normalised pixels from -1 to 1",
        "from -1 to 1",
    ),
    "y upwards": (
        _pixels(lambda uv, wh: np.stack([uv[..., 0], wh[..., 1] - uv[..., 1]], -1)),
        "y upwards",
        "lower edge",
    ),
    "row before column": (_pixels(lambda uv, _: uv[..., ::-1]), "row before column", "(y, x)"),
    "lens left out": (
        lambda rig, uv: (rig._replace(dist=np.zeros_like(rig.dist)), uv),
        "lens left out",
        "no terms of the lens",
    ),
    "lens used twice": (_undistorted, "lens used twice", "undistorted images already"),
    "sign of the lens": (
        lambda rig, uv: (rig._replace(dist=-rig.dist), uv),
        "sign of the lens",
        "wrong sign",
    ),
    "one camera late": (late(1), "time offset", "'{2}' +"),
}
"""How it is planted, the name of the finding, and what its text holds ({0} = name of the first camera)."""


def words(text: str, rig: Rig) -> str:
    """Return the text with the cameras' names filled in."""
    return text.format(*rig.names)
