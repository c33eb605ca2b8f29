"""Draw the error of fitted joints over views and pixel noise: `python tools/fitting_error.py docs/fitting_error.png`.

Synthetic takes as in `benchmarks/fitting.py` (own hand, unknown shape, cameras 1280 x 720, f = 900 px, 0.7-1.2 m
away); lines are the fit, dotted lines triangulation alone. Needs `pip install 'poem-jax[figures]'`.
"""

import argparse
import importlib
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from fitting import MODEL, error_row, make_take  # noqa: E402 - it lies in benchmarks/

from poem_jax.fitting.lm import ShapeMode
from poem_jax.fitting.solvers import FitConfig, fit_take

VIEWS = (2, 3, 4, 6, 8)
NOISE_PX = (0.5, 1.0, 2.0, 4.0)
FRAMES, TAKES = 50, 4


def main() -> None:
    """Measure, print the numbers, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    fit = jax.jit(partial(fit_take, MODEL, config=FitConfig()))
    rows = {}
    print("| noise, px | " + " | ".join(f"{views} views" for views in VIEWS) + " |")
    print("|---" * (1 + len(VIEWS)) + "|")
    for noise in NOISE_PX:
        takes = [[make_take(FRAMES, views, noise, 0.0, seed) for seed in range(TAKES)] for views in VIEWS]
        means = [np.mean([error_row(fit, t, ShapeMode.SHARED)[:2] for t in many], 0) for many in takes]
        rows[noise] = np.array(means)
        cells = " | ".join(f"{fitted:.2f} ({dlt:.2f})" for dlt, fitted in means)
        print(f"| {noise:g} | {cells} |", flush=True)
    draw(rows, out)


def draw(rows: dict[float, np.ndarray], out: Path) -> None:
    """Draw `rows` (noise -> views x (DLT, fit), mm) to a PNG."""
    matplotlib = importlib.import_module("matplotlib")
    matplotlib.use("Agg")
    figure, axes = importlib.import_module("matplotlib.pyplot").subplots(figsize=(7, 4.2))
    for index, (noise, errors) in enumerate(rows.items()):
        axes.plot(VIEWS, errors[:, 1], "o-", color=f"C{index}", label=f"{noise:g} px")
        axes.plot(VIEWS, errors[:, 0], ":", color=f"C{index}")
    axes.set(xlabel="views", ylabel="mean joint error, mm", xticks=VIEWS, yscale="log")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(title="noise of a coordinate")
    axes.set_title("Fitted joints (lines) and triangulation alone (dotted)")
    figure.tight_layout()
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
