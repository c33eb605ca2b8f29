"""Time and error of the fitting solvers on synthetic takes: `python benchmarks/fitting.py [--quick]`.

`--figure FILE` draws the error over views and pixel noise instead (`pip install 'poem-jax[figures]'`).

Own hand in natural poses, one unknown shape a take, cameras 1280 x 720 with f = 900 px in uniformly random
directions 0.7-1.2 m away (`poem_jax/synthetic/keypoint_takes.py`). Both
solvers see the same key points; neither uses a silhouette. The first call is stated apart; then the
contestants take turns, and medians are reported. `adam-300` starts at the triangulated wrist with the flat
hand, or, marked "same start", where `lm` starts.
"""

import argparse
import importlib
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.fitting import (
    FitConfig,
    FitResult,
    Observations,
    fit_take,
    fit_take_adam,
    keypoint_model,
    triangulate_robust,
)
from poem_jax.fitting.adam import AdamParameters
from poem_jax.fitting.lm import LMConfig, ShapeMode
from poem_jax.fitting.start import closed_form_pose
from poem_jax.geometry.transforms import quaternion_from_rotation, rotation_from_axis_angle
from poem_jax.geometry.triangulation import triangulate
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.keypoint_takes import KeypointTake, draw_keypoint_take

HAND = default_hand()
MODEL = keypoint_model(HAND)
FIGURE_VIEWS = (2, 3, 4, 6, 8)
FIGURE_NOISE_PX = (0.5, 1.0, 2.0, 4.0)
FIGURE_TICKS_MM = (0.2, 0.5, 1, 2, 4, 8)


def error_mm(result: FitResult, take: KeypointTake, what: str = "joints") -> float:
    """Return the mean distance from the truth over the valid frames."""
    distance = np.linalg.norm(getattr(result, what) - getattr(take, what)[: len(result.valid)], axis=-1)
    return 1000 * float(distance[np.asarray(result.valid)].mean())


def observed(take: KeypointTake, frames: int | None = None) -> Observations:
    """Return what the solvers see of the first `frames` (None = all) frames."""
    return Observations(take.uv_px[:frames], None, take.K, take.T_cam_from_world)


def same_start(take: KeypointTake) -> AdamParameters:
    """Return `lm`'s closed-form start as Adam's parameters."""
    points = triangulate_robust(observed(take), frame_axis=0)
    shape = jnp.zeros((len(take.uv_px), 10))
    pose, wrist = closed_form_pose(MODEL, points.points, points.valid, shape)
    return AdamParameters(quaternion_from_rotation(rotation_from_axis_angle(pose)), shape, wrist)


def contestants(take: KeypointTake) -> dict[str, tuple[Callable[[], FitResult], int]]:
    """Return name -> (call, frames a call)."""
    lm, adam = jax.jit(partial(fit_take, MODEL)), jax.jit(partial(fit_take_adam, MODEL))
    whole, alone = observed(take), observed(take, 1)
    begin = jax.jit(lambda uv: same_start(take._replace(uv_px=uv)))(take.uv_px)
    frames = len(take.uv_px)
    return {
        "adam-300 alone": (lambda: adam(alone), 1),
        "adam-300 batched": (lambda: adam(whole), frames),
        "adam-300 batched, same start": (lambda: adam(whole, start=begin), frames),
        "lm alone": (lambda: lm(alone), 1),
        "lm batched": (lambda: lm(whole), frames),
    }


def seconds(call: Callable[[], Any]) -> float:
    """Return the wall time of one call."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def time_table(frames: int, rounds: int) -> None:
    """Print ms a frame and joint error of every solver on 4 views of 2 px noise."""
    take = draw_keypoint_take(HAND, frames, 4, 2.0, seed=1)
    entries = contestants(take)
    first = {name: seconds(call) for name, (call, _) in entries.items()}
    spent: dict[str, list[float]] = {name: [] for name in entries}
    for _ in range(rounds):
        for name, (call, count) in entries.items():
            spent[name].append(1000 * seconds(call) / count)
    print(f"\n{frames} frames x 4 views, 2 px, medians of {rounds} rounds\n")
    print("| solver | ms a frame | first call, s | joints, mm |\n|---|---|---|---|")
    for name, (call, _) in entries.items():
        error = error_mm(call(), take)
        print(f"| {name} | {np.median(spent[name]):.2f} | {first[name]:.1f} | {error:.2f} |", flush=True)


def error_table(frames: int, seeds: int) -> None:
    """Print joint and vertex error of `lm` by views, noise, outliers and what is known of the shape."""
    print(f"\nlm, {seeds} takes of {frames} frames; 1 sigma = share of joint coordinates within sigma_m\n")
    print("| views | noise, px | outliers | shape | DLT, mm | joints, mm | vertices, mm | 1 sigma |")
    print("|---|---|---|---|---|---|---|---|")
    for views, noise in ((8, 1.0), (4, 2.0), (2, 2.0)):
        for mode in (ShapeMode.SHARED, ShapeMode.GIVEN):
            fit = jax.jit(partial(fit_take, MODEL, config=FitConfig(lm=LMConfig(shape_mode=mode))))
            for outliers in (0.0, 0.1):
                takes = [
                    draw_keypoint_take(HAND, frames, views, noise, seed, outlier_share=outliers)
                    for seed in range(seeds)
                ]
                row = np.mean([error_row(fit, take, mode) for take in takes], axis=0)
                print(
                    f"| {views} | {noise:g} | {outliers:.0%} | {mode} | {row[0]:.2f} | {row[1]:.2f} |", end=""
                )
                print(f" {row[2]:.2f} | {row[3]:.2f} |", flush=True)


def error_row(
    fit: Callable[..., FitResult], take: KeypointTake, mode: ShapeMode
) -> tuple[float, float, float, float]:
    """Return errors of DLT, joints and vertices in mm, and the share within one sigma."""
    result = fit(observed(take), shape=take.shape[0] if mode is ShapeMode.GIVEN else None)
    frames = len(take.uv_px)
    K, T = (np.broadcast_to(x, (frames, *x.shape)) for x in (take.K, take.T_cam_from_world))
    dlt = 1000 * np.linalg.norm(triangulate(take.uv_px, K, T)[0] - take.joints, axis=-1).mean()
    inside = np.abs(result.joints - take.joints) < np.asarray(result.sigma_m)[..., None]
    share = inside[np.asarray(result.valid)].mean()
    return float(dlt), error_mm(result, take), error_mm(result, take, "vertices"), float(share)


def figure(path: Path, frames: int, seeds: int) -> None:
    """Print and draw the mean joint error of fit and DLT; the shape is unknown."""
    fit = jax.jit(partial(fit_take, MODEL, config=FitConfig()))
    rows: dict[float, np.ndarray] = {}
    print("| noise, px | " + " | ".join(f"{views} views" for views in FIGURE_VIEWS) + " |")
    print("|---" * (1 + len(FIGURE_VIEWS)) + "|")
    for noise in FIGURE_NOISE_PX:
        takes = [
            [draw_keypoint_take(HAND, frames, views, noise, seed) for seed in range(seeds)]
            for views in FIGURE_VIEWS
        ]
        means = [np.mean([error_row(fit, t, ShapeMode.SHARED)[:2] for t in many], 0) for many in takes]
        rows[noise] = np.array(means)
        cells = " | ".join(f"{fitted:.2f} ({dlt:.2f})" for dlt, fitted in means)
        print(f"| {noise:g} | {cells} |", flush=True)
    # By name: type checkers run where the extra is not installed.
    importlib.import_module("matplotlib").use("Agg")
    drawing, axes = importlib.import_module("matplotlib.pyplot").subplots(figsize=(7, 4.2))
    for index, (noise, errors) in enumerate(rows.items()):
        axes.plot(FIGURE_VIEWS, errors[:, 1], "o-", color=f"C{index}", label=f"{noise:g} px")
        axes.plot(FIGURE_VIEWS, errors[:, 0], ":", color=f"C{index}")
    axes.set(xlabel="views", ylabel="mean joint error, mm", xticks=FIGURE_VIEWS, yscale="log")
    axes.set_yticks(FIGURE_TICKS_MM, map(str, FIGURE_TICKS_MM))
    axes.minorticks_off()
    axes.set_ylim(FIGURE_TICKS_MM[0], FIGURE_TICKS_MM[-1])
    axes.grid(True, alpha=0.3)
    axes.legend(title="noise of a coordinate", loc="center left", bbox_to_anchor=(1.01, 0.5))
    axes.set_title("Fitted joints (lines) and triangulation alone (dotted)")
    drawing.tight_layout()
    drawing.savefig(path, dpi=110)


def main() -> None:
    """Print both tables, or draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer frames, rounds and takes")
    parser.add_argument("--figure", type=Path, help="PNG to draw")
    given = parser.parse_args()
    quick = given.quick
    if given.figure:
        figure(given.figure, frames=50, seeds=1 if quick else 4)
        return
    time_table(frames=100 if quick else 500, rounds=3 if quick else 7)
    error_table(frames=50, seeds=2 if quick else 8)


if __name__ == "__main__":
    main()
