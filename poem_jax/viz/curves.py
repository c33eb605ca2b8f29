"""Curves as inline SVG: no script, no font, no network; colours of text and lines follow the page's."""

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from poem_jax.typing import Float

_W, _H = 400, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 20, 10, 42
"""Margins of the plot in the drawing's own units, which are pixels on a phone."""
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31", "#7f7f7f")
"""Tell apart also by those who see fewer colours (Okabe and Ito, 2008)."""
_MOST_POINTS = 300
_LARGEST = 1e300
"""Values beyond it are drawn there, and those below its inverse at 0: ranges and sums stay finite."""
_LEAST_RANGE = 1e-12
"""Of the values, relative to their size; narrower ones are drawn as a constant."""
_LOG_FROM = 30.0
"""The largest value over the smallest from which an axis of positive values may be logarithmic."""


class Curve(NamedTuple):
    """Values over steps."""

    name: str
    x: Float[np.ndarray, " point"]
    y: Float[np.ndarray, " point"]


def figure(
    title: str, curves: Sequence[Curve], *, x_label: str, y_label: str, may_be_log: bool = False
) -> str:
    """Draw curves in one plot, as a `<figure>` with a title and a legend.

    Values that are not finite are left out, and long curves are averaged down to 300 points.

    Args:
        title: above the plot.
        curves: at least one value in all.
        x_label, y_label: with units.
        may_be_log: positive values over more than a factor of 30 have a logarithmic axis.

    Raises:
        ValueError: no value is finite.
    """
    curves = [_thinned(_finite(curve)) for curve in curves]
    curves = [curve for curve in curves if curve.x.size]
    if not curves:
        raise ValueError(f"the figure {title!r} needs a finite value; got none")
    x_axis = _Axis.over(np.concatenate([curve.x for curve in curves]), log=False)
    values = np.concatenate([curve.y for curve in curves])
    low, high = float(values.min()), float(values.max())
    y_axis = _Axis.over(values, log=may_be_log and low > 0 and high > _LOG_FROM * low)
    y_label += ", logarithmic" if y_axis.log else ""
    lines = "".join(_line(curve, x_axis, y_axis, _colour(i)) for i, curve in enumerate(curves))
    legend = "".join(
        f'<span><i style="background:{_colour(i)}"></i>{escape(curve.name)}</span>'
        for i, curve in enumerate(curves)
    )
    return (
        f"<figure><figcaption>{escape(title)}</figcaption>"
        f'<svg viewBox="0 0 {_W} {_H}" role="img" aria-label="{escape(title)}">'
        f"{_grid(x_axis, y_axis)}{_labels(x_label, y_label)}{lines}</svg>"
        f'<p class="legend">{legend}</p></figure>'
    )


class _Axis(NamedTuple):
    low: float
    high: float
    log: bool
    ticks: tuple[float, ...]

    @staticmethod
    def over(values: Float[np.ndarray, " value"], *, log: bool) -> "_Axis":
        low, high = float(values.min()), float(values.max())
        if log:
            return _Axis(low, high, True, _decades(low, high))
        if high - low <= _LEAST_RANGE * max(-low, high):
            low, high = min(0.0, 2 * low), max(0.0, 2 * high) or float(low == 0)
        step = _round_up((high - low) / 5)
        low = math.floor(low / step + 1e-9) * step
        high = math.ceil(high / step - 1e-9) * step
        return _Axis(low, high, False, tuple(low + i * step for i in range(round((high - low) / step) + 1)))

    def place(self, values: Float[np.ndarray, " value"]) -> Float[np.ndarray, " value"]:
        """Return where values lie between the axis' ends, 0 to 1."""
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        return ((np.log(values) if self.log else values) - low) / (high - low)


def _decades(low: float, high: float) -> tuple[float, ...]:
    """Powers of ten between two values, with their twos and fives where there are few."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for digits in ((1,), (1, 2, 5)):
        ticks = tuple(d * 10.0**e for e in exponents for d in digits if low <= d * 10.0**e <= high)
        if len(ticks) >= 3:
            break
    return ticks[:: -(-len(ticks) // 7)]


def _round_up(step: float) -> float:
    """Return the next 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(digit * power for digit in (1, 2, 5, 10) if digit * power >= step * (1 - 1e-9))


def _finite(curve: Curve) -> Curve:
    x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
    kept = np.isfinite(x) & np.isfinite(y)
    y = np.clip(y[kept], -_LARGEST, _LARGEST)
    return Curve(curve.name, x[kept], np.where(np.abs(y) < 1 / _LARGEST, 0.0, y))


def _thinned(curve: Curve) -> Curve:
    """Average neighbours, so that a long run's page stays small."""
    if curve.x.size <= _MOST_POINTS:
        return curve
    first = np.linspace(0, curve.x.size, _MOST_POINTS, endpoint=False).astype(int)
    count = np.diff([*first, curve.x.size])
    return Curve(curve.name, *(np.add.reduceat(values, first) / count for values in (curve.x, curve.y)))


def _px(x: Float[np.ndarray, " point"], axis: _Axis) -> Float[np.ndarray, " point"]:
    return _LEFT + axis.place(x) * (_W - _LEFT - _RIGHT)


def _py(y: Float[np.ndarray, " point"], axis: _Axis) -> Float[np.ndarray, " point"]:
    return _H - _BOTTOM - axis.place(y) * (_H - _TOP - _BOTTOM)


def _line(curve: Curve, x_axis: _Axis, y_axis: _Axis, colour: str) -> str:
    px, py = _px(curve.x, x_axis), _py(curve.y, y_axis)
    if curve.x.size == 1:
        return f'<circle cx="{px[0]:.1f}" cy="{py[0]:.1f}" r="3" fill="{colour}"/>'
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(px, py, strict=True))
    return f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.6"/>'


def _grid(x_axis: _Axis, y_axis: _Axis) -> str:
    parts = []
    for tick, x in zip(x_axis.ticks, _px(np.array(x_axis.ticks), x_axis), strict=True):
        parts.append(f'<path class="grid" d="M{x:.1f} {_TOP}V{_H - _BOTTOM}"/>')
        parts.append(f'<text x="{x:.1f}" y="{_H - _BOTTOM + 15}" text-anchor="middle">{_short(tick)}</text>')
    for tick, y in zip(y_axis.ticks, _py(np.array(y_axis.ticks), y_axis), strict=True):
        parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{_W - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{_short(tick)}</text>')
    return "".join(parts)


def _labels(x_label: str, y_label: str) -> str:
    x, y = (_LEFT + _W - _RIGHT) / 2, (_TOP + _H - _BOTTOM) / 2
    return (
        f'<text x="{x}" y="{_H - 8}" text-anchor="middle">{escape(x_label)}</text>'
        f'<text x="14" y="{y}" text-anchor="middle" transform="rotate(-90 14 {y})">{escape(y_label)}</text>'
    )


def _short(value: float) -> str:
    """Write a tick: 0, 0.25, 1500, 20k, 2M, 1e-4, 1e12."""
    if not 1e-3 <= abs(value) < 1e9 and value != 0:
        mantissa, _, exponent = f"{value:.3e}".partition("e")
        return f"{float(mantissa):g}e{int(exponent)}"
    for size, letter in ((1e6, "M"), (1e4, "k")):
        if abs(value) >= size:
            return f"{value / (1e6 if letter == 'M' else 1e3):.4g}{letter}"
    # What floating point makes of 3 x 0.1.
    return f"{round(value, 9):.5g}"


def _colour(index: int) -> str:
    return _COLOURS[index % len(_COLOURS)]
