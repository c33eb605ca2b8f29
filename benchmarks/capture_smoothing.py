"""The row `smoothing` of `benchmarks/capture.py`: what smoothing gives and what it costs, against the truth.

A synthetic hand (`poem_jax/synthetic/moving_takes.py`) at 30 frames a second, at rest and at three paces: on
average 0.25, 0.5 and 1 m/s. Two kinds of noise: the fit's own results, frame by frame, from key points of
four cameras with 2 px of noise; and a stand-in for a network's meshes: the whole hand off by 5 mm (each
coordinate, anew in every frame) and turned by 2 degrees about each axis, its points off by 1 mm each. All
goes through the stage itself. The constants of the filters were chosen on other seeds (from 100 on).
"""

from typing import NamedTuple

import jax
import numpy as np

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.smoothing import OFF, Smoother, Smoothing
from poem_jax.capture.take import Take
from poem_jax.fitting import FitConfig, Observations, fit_take, keypoint_model
from poem_jax.fitting.smooth import SmoothConfig
from poem_jax.geometry.cameras import project
from poem_jax.geometry.rig import Rig
from poem_jax.geometry.transforms import rotate_points, rotation_from_axis_angle
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.pair import hands_of
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.synthetic.keypoint_takes import IMAGE_WH, KeypointTake
from poem_jax.synthetic.moving_takes import Motion, see_motion
from poem_jax.typing import Array

RATE, FRAMES, VIEWS, NOISE_PX = 30, 192, 4, 2.0
PACES = (0.5, 1.0, 2.0)
SEEDS = range(3)
NETWORK_M, NETWORK_TURN, NETWORK_POINT_M = 0.005, np.deg2rad(2), 0.001
SETTLED = slice(15, -15)
"""Frames that count: filters have begun, and have not ended."""
HAND = default_hand()
MODEL = keypoint_model(HAND)
TIMES = np.arange(FRAMES) / RATE
DELAYS = np.arange(-0.02, 0.1, 0.004)


class Row(NamedTuple):
    """What one way of smoothing gives on one take; errors are root mean squares over the joints."""

    error_mm: float
    error_px: float
    second_difference_mm: float
    late_ms: float


def fitted(take: KeypointTake, second_pass: bool) -> list[HandResult]:
    """Fit a take, its frames one by one or together."""
    seen = Observations(take.uv_px, np.ones(take.uv_px.shape[:-1]), take.K, take.T_cam_from_world)
    config = FitConfig(smooth=SmoothConfig() if second_pass else None)
    found = jax.device_get(fit_take(MODEL, seen, config=config, time_s=TIMES))
    every = np.ones(VIEWS, bool)
    return [
        HandResult(
            every,
            vertices_world=found.vertices[f],
            joints_world=found.joints[f],
            root_world=found.joints[f, ROOT_JOINT],
            pose=found.pose[f],
            shape=found.shape[f],
            translation=found.translation[f],
            joint_sigma_m=found.sigma_m[f],
        )
        for f in range(FRAMES)
    ]


def network_like(take: KeypointTake, seed: int) -> list[HandResult]:
    """Return meshes that are off as a network's are."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([take.joints, take.vertices], axis=1).astype(np.float64)
    centre = points.mean(1, keepdims=True)
    turns = rotation_from_axis_angle(NETWORK_TURN * rng.normal(size=(FRAMES, 3)))
    points = rotate_points(turns, points - centre) + centre + NETWORK_M * rng.normal(size=(FRAMES, 1, 3))
    points = (points + NETWORK_POINT_M * rng.normal(size=points.shape)).astype(np.float32)
    every = np.ones(VIEWS, bool)
    return [
        HandResult(every, None, vertices_world=p[21:], joints_world=p[:21], root_world=p[ROOT_JOINT])
        for p in points
    ]


def through_the_stage(hands: list[HandResult], take: KeypointTake, smoothing: Smoothing) -> Array:
    """Return the joints (frame, 21, 3) that the stage gives on."""
    boxes = np.full((1, VIEWS, 4), np.nan)
    frames = [Frame(str(f), boxes, hands=(hand,), time_s=TIMES[f]) for f, hand in enumerate(hands)]
    names = tuple(map(str, range(VIEWS)))
    rig = Rig(names, np.tile(IMAGE_WH, (VIEWS, 1)), take.K, np.zeros((VIEWS, 5)), take.T_cam_from_world)
    smoother = Smoother(Take(rig, ("right",), frames), smoothing, hands_of(HAND))
    return np.stack([np.asarray(frame.hands[0].joints_world) for frame in smoother.smooth(frames)])


def measured(joints: Array, take: KeypointTake, delayed: Array) -> Row:
    """Hold joints against the truth."""
    off = (joints - take.joints)[SETTLED]
    pixels = [
        project(take.K[None], take.T_cam_from_world[None], x[:, None])[0] for x in (joints, take.joints)
    ]
    return Row(
        1000 * rms(off),
        rms((pixels[0] - pixels[1])[SETTLED]),
        1000 * rms(np.diff(joints - take.joints, 2, axis=0)[SETTLED]),
        1000 * lateness(joints, delayed),
    )


def truth_delayed(motion: Motion) -> Array:
    """Return where the joints were `DELAYS` earlier: (delay, frame, 21, 3)."""
    pose, place = motion.at((TIMES[None] - DELAYS[:, None]).ravel())
    shape = np.tile(motion.shape, (len(pose), 1))
    joints = hand_mesh(HAND, pose, shape, place, center_joint=ROOT_JOINT).joints
    return joints.reshape(len(DELAYS), FRAMES, 21, 3)


def lateness(joints: Array, delayed: Array) -> float:
    """Return by how many seconds the truth must be late to come nearest."""
    return float(DELAYS[np.argmin([rms((joints - each)[SETTLED]) for each in delayed])])


def rms(x: Array) -> float:
    """Return the root mean square length of vectors."""
    return float(np.sqrt(np.mean(np.sum(np.square(x, dtype=np.float64), axis=-1))))


def rows(pace: float, seeds: range = SEEDS) -> dict[tuple[str, str], Row]:
    """Return the mean over takes at one pace, for every noise and way of smoothing."""
    found: dict[tuple[str, str], list[Row]] = {}
    for seed in seeds:
        motion = Motion(seed, pace, FRAMES / RATE)
        take = see_motion(motion, HAND, TIMES, VIEWS, NOISE_PX, seed)
        delayed = truth_delayed(motion)
        alone, together, network = fitted(take, False), fitted(take, True), network_like(take, seed)
        off, causal, offline = OFF, Smoothing("causal"), Smoothing("offline")
        for name, way, hands, done in (
            ("fit", "off", alone, off),
            ("fit", "causal", alone, causal),
            ("fit", "second pass alone", together, off),
            ("fit", "offline", together, offline),
            ("network", "off", network, off),
            ("network", "causal", network, causal),
            ("network", "offline", network, offline),
        ):
            joints = through_the_stage(hands, take, done)
            found.setdefault((name, way), []).append(measured(joints, take, delayed))
    return {key: Row(*np.mean(many, axis=0)) for key, many in found.items()}


def smoothing() -> None:
    """Print jitter at rest, lateness and error on the move."""
    rest, moving = rows(0.0), [rows(pace) for pace in PACES]
    print("| noise | smoothing | at rest: mm, px, second differences mm | less by |", end="")
    print("".join(f" at {pace / 2:g} m/s: late, error |" for pace in PACES))
    print("|---" * (4 + len(PACES)) + "|")
    for (name, way), still in rest.items():
        before = rest[name, "off"]
        cells = [f"{still.error_mm:.2f}, {still.error_px:.2f}, {still.second_difference_mm:.2f}"]
        cells += [
            f"{before.error_mm / still.error_mm:.1f} x, "
            f"{before.second_difference_mm / still.second_difference_mm:.1f} x"
        ]
        for at_pace in moving:
            row, plain = at_pace[name, way], at_pace[name, "off"]
            cells += [
                f"{row.late_ms:.0f} ms, {row.error_mm:.2f} mm, {row.error_mm / plain.error_mm - 1:+.0%}"
            ]
        print(f"| {name} | {way} | " + " | ".join(cells) + " |", flush=True)
