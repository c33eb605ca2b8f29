"""Measure what a network's signs of doubt are worth, and what a confidence means: `capture/network_trust.py`.

    python tools/measure_trust.py [--checkpoint DIR] [--samples 150]

Synthetic captures of the benchmark's distribution, seen by 2, 3, 4 and 8 views. The scale is measured on one
seed: factors by the least absolute errors in units of their standard deviation (Laplace's
likelihood, which a few lost hands do not rule), then all of it widened or narrowed until 68.3 % of the
coordinates lie within one. The shares are told for another seed, that of the benchmark, which was used for
neither training nor measuring. The fit's confidence is told for takes of key points of which one in ten lies
far off.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import minimize

from poem_jax.capture.fit import try_fit
from poem_jax.capture.frame import Frame, HandCrops
from poem_jax.capture.network import Network, load_network
from poem_jax.capture.network_trust import (
    Doubts,
    TrustScale,
    doubts_of,
    joint_confidence,
    joint_sigma,
)
from poem_jax.capture.take import Take
from poem_jax.evaluation.benchmark import DEFAULT_SEED
from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.rig import Rig
from poem_jax.hand.pair import hands_of
from poem_jax.hand.template import default_hand
from poem_jax.io.compilation_cache import use_compilation_cache
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.keypoint_takes import IMAGE_WH, draw_keypoint_take

MEASURED_SEED = 5150
"""Of no training, and of no table."""
VIEWS = (2, 3, 4, 8)
WITHIN_ONE_SIGMA = 0.6827
BINS = (0.9, 0.5, 0.1, 0.0)
NEAR_SHARE = 0.05
"""Of the crop's side: what the table calls near."""


class Observed(NamedTuple):
    """One hand that the network found."""

    doubts: Doubts
    error_m: np.ndarray
    """Of every coordinate of the joints (21, 3)."""
    point_off_share: np.ndarray
    """Distance of the heat map's point from the true joint (view, 21), as a share of the crop's side."""
    visible: np.ndarray
    """Whether the view shows the joint (view, 21)."""


def observe(network: Network, seed: int, samples: int) -> dict[int, list[Observed]]:
    """Run the network on captures 0, 1, ... of a seed, by number of views."""
    captures = SyntheticDataset(benchmark, seed)
    rows: dict[int, list[Observed]] = {views: [] for views in VIEWS}
    for index in range(samples):
        sample = captures.render_sample(index, max(VIEWS))
        for views in VIEWS:
            batch = sample.batch
            crops = HandCrops(
                batch.views[:views],
                batch.cameras.K[:views],
                batch.cameras.T_cam_from_world[:views],
                np.ones(views, bool),
            )
            cams = Cameras(crops.K[None], crops.T_cam_from_world[None], crops.view_mask[None])
            found = jax.device_get(network.predict(network.prepared, crops.views[None], cams))
            found = jax.tree.map(lambda leaf: leaf[0], found)
            if found.valid:
                true_px = batch.keypoints_px[:views]
                off = np.linalg.norm(found.keypoints_px - true_px, axis=-1) / max(crops.views.shape[1:3])
                doubts = doubts_of(found, crops, network.config.query_order)
                error_m = np.asarray(found.joints_world, np.float64) - batch.joints_world
                rows[views].append(Observed(doubts, error_m, off, sample.joint_visible[:views]))
    return rows


def measured_scale(rows: dict[int, list[Observed]]) -> TrustScale:
    """Return the scale that fits the errors best."""
    seen = [row for many in rows.values() for row in many]
    error_m = np.stack([row.error_m for row in seen])
    spread, off, visible = (
        np.concatenate([array.ravel() for array in arrays])
        for arrays in (
            [np.asarray(row.doubts.spread_share) for row in seen],
            [row.point_off_share for row in seen],
            [row.visible for row in seen],
        )
    )

    def scale_of(logs: np.ndarray) -> TrustScale:
        layers, rays = map(float, np.exp(logs))
        # The distance in a plane has its median at 1.177 standard deviations of a coordinate.
        off_share = float(np.median(off[visible])) / 1.1774
        return TrustScale(layers, rays, float(np.median(spread[visible])), off_share, True)

    def sigmas(scale: TrustScale) -> np.ndarray:
        return np.stack([np.asarray(joint_sigma(row.doubts, scale)) for row in seen])[..., None]

    def cost(logs: np.ndarray) -> float:
        sigma = sigmas(scale_of(logs))
        return float(np.mean(np.log(sigma) + np.abs(error_m) / sigma))

    logs = minimize(cost, np.log([1.0, 0.5]), method="Nelder-Mead").x
    units = np.abs(error_m) / sigmas(scale_of(logs))
    return scale_of(logs + np.log(np.quantile(units, WITHIN_ONE_SIGMA)))


def share_table(rows: dict[int, list[Observed]], scale: TrustScale) -> None:
    """Print how many errors of a coordinate lie within one and two standard deviations."""
    print("| views | hands | median error of a coordinate, mm | median sigma, mm | within 1 | within 2 |")
    for views, many in rows.items():
        sigma = np.stack([np.asarray(joint_sigma(row.doubts, scale)) for row in many])[..., None]
        error = np.abs(np.stack([row.error_m for row in many]))
        one, two = (100 * (error < k * sigma).mean() for k in (1, 2))
        print(
            f"| {views} | {len(many)} | {1000 * np.median(error):.2f} | {1000 * np.median(sigma):.2f} | "
            f"{one:.1f} % | {two:.1f} % |"
        )


def network_confidence_table(rows: dict[int, list[Observed]], scale: TrustScale) -> None:
    """Print what the network's confidences are worth, over all numbers of views."""
    seen = [row for many in rows.values() for row in many]
    confidence = np.concatenate([np.asarray(joint_confidence(row.doubts, scale)).ravel() for row in seen])
    off = np.concatenate([row.point_off_share.ravel() for row in seen])
    visible = np.concatenate([row.visible.ravel() for row in seen])
    print(
        "| confidence | share | joint in plain view | heat map within 5 % of the crop's side of the truth |"
    )
    for low, mask in _bins(confidence):
        print(
            f"| {low:.1f} and more | {100 * mask.mean():.0f} % | {100 * visible[mask].mean():.0f} % | "
            f"{100 * (off[mask] < NEAR_SHARE).mean():.0f} % |"
        )


def fit_confidence_table(takes: int = 4, frames: int = 40, views: int = 4, noise_px: float = 2.0) -> None:
    """Print what the fit's confidences are worth: key points with noise, one in ten 50 px off."""
    hands, names = hands_of(default_hand()), tuple(f"cam_{view}" for view in range(views))
    confidence, off = [], []
    for seed in range(takes):
        drawn = draw_keypoint_take(hands.right, frames, views, noise_px, seed, outlier_share=0.1)
        rig = Rig(
            names,
            np.tile(IMAGE_WH, (views, 1)),
            drawn.K.astype(np.float64),
            np.zeros((views, 5)),
            drawn.T_cam_from_world.astype(np.float64),
        )
        boxes = np.zeros((1, views, 4))
        given = [Frame(f"{i:04d}", boxes, uv[None].astype(np.float64)) for i, uv in enumerate(drawn.uv_px)]
        found = list(try_fit(given, Take(rig, ("right",), given), hands))
        true_px, _ = project(
            rig.K[None], rig.T_cam_from_world[None], drawn.joints[:, None].astype(np.float64)
        )
        confidence.append([frame.hands[0].joint_confidence for frame in found])
        off.append(np.linalg.norm(drawn.uv_px - true_px, axis=-1))
    confidence, off = np.ravel(confidence), np.ravel(off)
    print(f"| confidence | share | key point within 3 sigma ({3 * noise_px:g} px) of the truth |")
    for low, mask in _bins(confidence):
        print(f"| {low:.1f} and more | {100 * mask.mean():.0f} % | {100 * (off[mask] < 6).mean():.0f} % |")


def _bins(confidence: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Return the lower ends of the ranges of confidence, and who is in them."""
    highs = (np.inf, *BINS[:-1])
    return [(low, (confidence >= low) & (confidence < high)) for low, high in zip(BINS, highs, strict=True)]


def main() -> None:
    """Measure the scale, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--samples", type=int, default=150)
    arguments = parser.parse_args()
    use_compilation_cache()
    network = load_network(arguments.checkpoint)
    scale = measured_scale(observe(network, MEASURED_SEED, arguments.samples))
    print(f"{scale}\n")
    held_out = observe(network, DEFAULT_SEED, arguments.samples)
    share_table(held_out, scale)
    network_confidence_table(held_out, scale)
    fit_confidence_table()


if __name__ == "__main__":
    main()
