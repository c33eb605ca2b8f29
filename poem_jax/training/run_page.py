"""A run as one HTML page: how it ended, its newest numbers, its newest picture, and its curves."""

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from poem_jax.viz.curves import Curve, figure

Entry = Mapping[str, Any]
"""A line of `metrics.jsonl`."""


@dataclass(frozen=True)
class _Plot:
    """A figure, and which metrics are in it."""

    title: str
    y_label: str
    has: Callable[[str, str], bool]
    """Of a group and a name."""
    may_be_log: bool = False


_COSTS = ("steps_per_second", "samples_per_second", "data_wait_share", "peak_memory_mb", "bad_steps")


def _train(*names: str) -> Callable[[str, str], bool]:
    return lambda group, name: group == "train" and name in names


def _is_term(group: str, name: str) -> bool:
    others = (*_COSTS, "loss", "learning_rate", "gradient_norm")
    return group == "train" and name not in others and not name.endswith(("_mm", "_px"))


_PLOTS = (
    _Plot("Loss", "loss", _train("loss"), True),
    _Plot("Terms of the loss", "term, unweighted", _is_term, True),
    _Plot("Errors, training samples", "mm", lambda group, name: group == "train" and name.endswith("_mm")),
    _Plot(
        "Key points, training samples", "px", lambda group, name: group == "train" and name.endswith("_px")
    ),
    _Plot(
        "Vertex error, held out",
        "mm, mean",
        lambda group, name: group == "validation" and name.startswith("mpvpe_mm"),
    ),
    _Plot(
        "Other errors, held out",
        "mm",
        lambda group, name: group == "validation" and not name.startswith(("mpvpe_mm", "unsolved_share")),
    ),
    _Plot(
        "Not solved, held out",
        "share of the samples",
        lambda group, name: group == "validation" and name.startswith("unsolved_share"),
    ),
    _Plot("Learning rate", "rate", _train("learning_rate")),
    _Plot("Gradient", "norm", _train("gradient_norm"), True),
    _Plot("Speed", "samples / s", _train("samples_per_second")),
    _Plot("Waiting for data", "share of the time", _train("data_wait_share")),
    _Plot("Memory", "MB, largest so far", _train("peak_memory_mb")),
    _Plot("Steps left out", "steps since the last line", _train("bad_steps")),
)


def page(title: str, facts: Mapping[str, str], entries: Sequence[Entry], picture: Path | None) -> str:
    """Write the page; it needs no other file.

    Args:
        title: the run's name.
        facts: rows of the table at the top.
        entries: the run's metrics, in the order of writing.
        picture: newest panel of predictions, a PNG, or None.
    """
    rows = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts.items()
    )
    shown = "" if picture is None else _embedded(picture)
    figures = "".join(_figures(entries)) or "<p>No metrics were written.</p>"
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head>\n<body><h1>{escape(title)}</h1>\n<table>{rows}</table>\n"
        f'{shown}\n<div class="figures">{figures}</div></body></html>\n'
    )


def _figures(entries: Sequence[Entry]) -> list[str]:
    drawn = []
    series = _series(entries)
    for plot in _PLOTS:
        curves = [
            Curve(name, *values)
            for (group, name), values in series.items()
            if plot.has(group, name) and np.isfinite(values[1]).any()
        ]
        if curves:
            drawn.append(
                figure(plot.title, curves, x_label="step", y_label=plot.y_label, may_be_log=plot.may_be_log)
            )
    return drawn


def _series(entries: Sequence[Entry]) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]:
    """Return steps and values by group and name."""
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for entry in entries:
        for name, value in entry.items():
            if name not in ("step", "group", "seconds") and isinstance(value, int | float):
                found.setdefault((entry.get("group", ""), name), []).append((entry["step"], value))
    return {
        key: (np.array([x for x, _ in both]), np.array([y for _, y in both])) for key, both in found.items()
    }


def _embedded(picture: Path) -> str:
    """Return the picture as a JPEG inside the page: nothing, where it is gone or cannot be read."""
    pixels = cv2.imread(str(picture))
    if pixels is None:
        return ""
    ok, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 88])
    if not ok:
        return ""
    text = base64.b64encode(data.tobytes()).decode()
    caption = f"What the model finds in held-out samples ({escape(picture.name)})"
    return (
        f'<figure class="panel"><figcaption>{caption}</figcaption>'
        f'<img alt="{caption}" src="data:image/jpeg;base64,{text}"></figure>'
    )


_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.4 system-ui, sans-serif; margin: 0 auto; max-width: 80rem; padding: 0.6rem; }
h1 { font-size: 1.3rem; margin: 0.4rem 0; overflow-wrap: anywhere; }
table { border-collapse: collapse; }
th, td { text-align: left; vertical-align: top; padding: 0.1rem 0.8rem 0.1rem 0; overflow-wrap: anywhere; }
th { font-weight: normal; opacity: 0.7; white-space: nowrap; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 22rem), 1fr)); gap: 1rem; }
figure { margin: 1rem 0 0; min-width: 0; }
figcaption { font-weight: 600; }
svg, img { width: 100%; height: auto; display: block; }
svg text { font: 12.5px system-ui, sans-serif; fill: currentColor; }
.grid { stroke: currentColor; stroke-opacity: 0.15; fill: none; }
.legend { margin: 0; font-size: 0.8rem; display: flex; flex-wrap: wrap; gap: 0 0.9rem; }
.legend i { display: inline-block; width: 0.9rem; height: 0.25rem; margin: 0 0.3rem 0.2rem 0; }
.panel { overflow-x: auto; }
"""
