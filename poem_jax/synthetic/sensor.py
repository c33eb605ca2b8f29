"""What a camera does to light: blur, motion, exposure, white balance, tone curve, noise, JPEG."""

from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.synthetic.config import SensorConfig
from poem_jax.synthetic.shading import develop
from poem_jax.synthetic.viewpoints import within
from poem_jax.typing import Array, Float, UInt8

_NUMBERS = 20
_CURVE_STEPS = 1024
_MIN_BLUR_PX = 0.3


class Exposure(NamedTuple):
    """One camera's settings for one picture."""

    gains: Float[Array, "3"]
    gamma: float
    blur_px: float
    motion_px: int
    """Length of the smear; 0 = none."""
    motion_angle: float
    noise: float
    jpeg_quality: int
    """0 = not compressed."""
    seed: int
    background: int
    warp: Float[Array, "2 3"]
    """Background pixels from crop pixels."""
    background_gain: Float[Array, "3"]


def draw_exposures(
    config: SensorConfig, rng: np.random.Generator, num_views: int, num_backgrounds: int, background_size: int
) -> list[Exposure]:
    """Draw settings for every view, row by row: the first views do not depend on how many follow."""
    table = rng.random((num_views, _NUMBERS))
    return [_exposure(config, row, num_backgrounds, background_size) for row in table]


def warp_background(
    texture: UInt8[Array, "side side 3"], exposure: Exposure, hw: tuple[int, int]
) -> tuple[UInt8[Array, "h w 3"], Float[Array, "256 3"]]:
    """Return the background behind an image of size `hw` (mirrored beyond the texture's edges), and the
    table from its bytes to linear light per channel."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    behind = cv2.warpAffine(texture, exposure.warp, hw[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT_101)
    return behind, ((np.arange(256)[:, None] / 255) ** 2 * exposure.background_gain).astype(np.float32)


def develop_picture(light: Float[Array, "h w 3"], exposure: Exposure) -> UInt8[Array, "h w 3"]:
    """Turn an image of linear light (float32) into what a camera's file would hold."""
    if exposure.blur_px >= _MIN_BLUR_PX:
        light = cv2.GaussianBlur(light, (0, 0), exposure.blur_px)
    if exposure.motion_px > 1:
        light = cv2.filter2D(light, -1, _smear(exposure.motion_px, exposure.motion_angle))
    pixels = np.empty(light.shape, np.uint8)
    curve = 255 * np.linspace(0, 1, _CURVE_STEPS) ** exposure.gamma
    develop(light, exposure.gains, curve, exposure.noise, exposure.seed, pixels)
    return _through_jpeg(pixels, exposure.jpeg_quality) if exposure.jpeg_quality else pixels


def _exposure(config: SensorConfig, u: Float[Array, " n"], num_backgrounds: int, size: int) -> Exposure:
    balance = 1 + config.white_balance * (2 * u[1:4] - 1)
    # A gain is a ratio: it spreads evenly on a logarithmic scale.
    gain = np.exp(within((float(np.log(config.gain[0])), float(np.log(config.gain[1]))), u[0]))
    tint = 1 + config.white_balance * (u[[19, 12, 13]] - 0.5)
    return Exposure(
        gains=gain * balance,
        gamma=float(within(config.gamma, u[4])),
        blur_px=float(within(config.blur_px, u[5])),
        motion_px=_whole(config.motion_px, u[7]) if u[6] < config.motion_probability else 0,
        motion_angle=float(np.pi * u[8]),
        noise=float(within(config.noise, u[9])),
        jpeg_quality=_whole(config.jpeg_quality, u[11]) if u[10] < config.jpeg_probability else 0,
        seed=int(u[12] * 2**52),
        background=int(u[13] * num_backgrounds),
        warp=_warp(u[14:18], size),
        background_gain=(0.3 + u[18]) * tint,
    )


def _whole(bounds: tuple[int, int], uniform: float) -> int:
    """Map a uniform number in [0, 1) to a whole one, both bounds included."""
    return bounds[0] + int(uniform * (bounds[1] + 1 - bounds[0]))


def _warp(u: Float[Array, "4"], size: int) -> Float[Array, "2 3"]:
    """Return a random turn, zoom (a quarter to one texture pixel and more per crop pixel) and shift."""
    zoom, angle = 0.25 * 8 ** u[0], 2 * np.pi * u[1]
    c, s = zoom * np.cos(angle), zoom * np.sin(angle)
    return np.array([[c, -s, size * u[2]], [s, c, size * u[3]]])


def _smear(length: int, angle: float) -> Float[Array, "k k"]:
    """Return the kernel of a straight movement during the exposure."""
    size = length | 1
    reach = length / 2 * np.array([np.cos(angle), np.sin(angle)])
    kernel = np.zeros((size, size), np.float32)
    place = size // 2 + np.linspace(-1, 1, 2 * size)[:, None] * reach
    column, row = np.clip(np.round(place), 0, size - 1).astype(int).T
    np.add.at(kernel, (row, column), 1.0)
    return kernel / kernel.sum()


def _through_jpeg(pixels: UInt8[Array, "h w 3"], quality: int) -> UInt8[Array, "h w 3"]:
    # OpenCV takes BGR; the codec weighs colours differently.
    code = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR))[..., ::-1]
