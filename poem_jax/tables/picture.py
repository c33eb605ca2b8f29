"""A table as a picture: bars by system, and the error over the number of views; drawn by OpenCV.

The paper's bars are grey, ours blue. What is drawn is the first column of each line.
"""

import os
from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import cv2
import numpy as np

from poem_jax.evaluation.tables import Column
from poem_jax.io.atomic import whole_file
from poem_jax.tables.layout import COLUMNS
from poem_jax.tables.result import Line, TableResult
from poem_jax.typing import UInt8

WIDTH = 1000
_ROW, _HEAD, _MARGIN, _LABELS, _VALUES = 34, 44, 24, 320, 70
_CURVE_HEIGHT, _NAME_HEIGHT = 360, 16
_GREY, _BLUE, _INK, _PALE = (170, 170, 170), (190, 110, 30), (40, 40, 40), (225, 225, 225)
"""BGR, as OpenCV has colours."""


class Point(NamedTuple):
    """A number of a curve."""

    num_views: int
    value: float


def draw_table(result: TableResult) -> UInt8[np.ndarray, "h w 3"]:
    """Draw bars of all lines that have a number, a group a data set, and below them the curves.

    Returns: RGB.
    """
    panels = [
        draw_bars(group, list(lines)) for group, lines in groupby(result.lines, key=lambda line: line.group)
    ]
    if curves := curves_of(result.lines):
        panels.append(draw_curves(curves, _column(result.lines[0])))
    return np.concatenate(panels)[..., ::-1]


def write_picture(path: str | os.PathLike, result: TableResult) -> None:
    """Write `draw_table` as PNG; it appears whole or not at all."""
    image = draw_table(result)
    with whole_file(path) as file:
        cv2.imwrite(str(file), np.ascontiguousarray(image[..., ::-1]))


def curves_of(lines: Sequence[Line]) -> dict[str, dict[str, list[Point]]]:
    """Return by series the points of `paper` and `ours` over the number of views, where there are two or
    more of either."""
    curves: dict[str, dict[str, list[Point]]] = {}
    for line in lines:
        if line.num_views is None:
            continue
        points = curves.setdefault(line.series, {"paper": [], "ours": []})
        for name, numbers in (("paper", line.paper), ("ours", line.ours or {})):
            if line.columns[0] in numbers:
                points[name].append(Point(line.num_views, numbers[line.columns[0]]))
    return {
        series: {name: sorted(points) for name, points in both.items()}
        for series, both in curves.items()
        if max(len(points) for points in both.values()) > 1
    }


def draw_bars(title: str, lines: Sequence[Line]) -> UInt8[np.ndarray, "h w 3"]:
    """Draw one group, BGR."""
    column = _column(lines[0])
    values = [(line.paper.get(column.metric), (line.ours or {}).get(column.metric)) for line in lines]
    longest = max((value for pair in values for value in pair if value is not None), default=1.0)
    image = np.full((_HEAD + _ROW * len(lines) + _MARGIN // 2, WIDTH, 3), 255, np.uint8)
    _text(image, f"{title}: {column.title}", (_MARGIN, 30), bold=True)
    if any(paper is not None for paper, _ in values):
        _legend(image)
    scale = (WIDTH - _LABELS - _VALUES - _MARGIN) / longest
    for number, (line, pair) in enumerate(zip(lines, values, strict=True)):
        top = _HEAD + _ROW * number
        _text(image, line.label[:38], (_MARGIN, top + 19))
        for half, (value, color) in enumerate(zip(pair, (_GREY, _BLUE), strict=True)):
            if value is None:
                continue
            y, end = top + 3 + 13 * half, _LABELS + max(round(scale * value), 1)
            cv2.rectangle(image, (_LABELS, y), (end, y + 11), color, cv2.FILLED)
            _text(image, f"{value:.{column.decimals}f}", (end + 6, y + 10), size=0.4)
    return image


def draw_curves(curves: dict[str, dict[str, list[Point]]], column: Column) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the error over the number of views, a thin line the paper's and a thick one ours; BGR.

    Each series has its own colour and is named at its right end; names keep apart from each other.
    """
    every = [point for both in curves.values() for points in both.values() for point in points]
    low, high = min(p.num_views for p in every), max(p.num_views for p in every)
    top = 1.1 * max(p.value for p in every)
    height = max(_CURVE_HEIGHT, 110 + _NAME_HEIGHT * len(curves))
    image = np.full((height, WIDTH, 3), 255, np.uint8)
    _text(image, f"{column.title} over the number of views", (_MARGIN, 30), bold=True)
    if any(both["paper"] for both in curves.values()):
        _text(image, "thin: paper, thick: ours", (WIDTH - 210, 29), size=0.4)
    left, right, floor, roof = 80, WIDTH - _LABELS - 40, height - 40, 60

    def place(point: Point) -> tuple[int, int]:
        across = (point.num_views - low) / max(high - low, 1)
        return round(left + across * (right - left)), round(floor - point.value / top * (floor - roof))

    for share in np.linspace(0, 1, 5):
        y = round(floor - share * (floor - roof))
        cv2.line(image, (left, y), (right, y), _PALE)
        _text(image, f"{share * top:.{column.decimals}f}", (_MARGIN, y + 4), size=0.4)
    for count in sorted({point.num_views for point in every}):
        x, _ = place(Point(count, 0.0))
        _text(image, str(count), (x - 4, floor + 22))
    colors = dict(zip(curves, _colors(len(curves)), strict=True))
    for series, both in curves.items():
        for points, width in ((both["paper"], 1), (both["ours"], 2)):
            corners = [place(point) for point in points]
            cv2.polylines(image, [np.array(corners, np.int32)], False, colors[series], width, cv2.LINE_AA)
            for corner in corners:
                cv2.circle(image, corner, 3, colors[series], cv2.FILLED, cv2.LINE_AA)
    ends = {series: place(max(both["ours"] or both["paper"])) for series, both in curves.items()}
    heights = spread_out([y for _, y in ends.values()], _NAME_HEIGHT, roof - 10, floor)
    for (series, end), y in zip(ends.items(), heights, strict=True):
        cv2.line(image, (end[0] + 5, end[1]), (right + 22, y), colors[series], 1, cv2.LINE_AA)
        _text(image, series[:46], (right + 26, y + 4), size=0.4, color=colors[series])
    return image


def spread_out(wanted: Sequence[int], gap: int, low: int, high: int) -> list[int]:
    """Return whole numbers near those wanted, in their order, `gap` or more apart and from `low` to `high`.

    Where there is no room for all, they go beyond `high`.
    """
    order = np.argsort(wanted, kind="stable")
    placed = np.asarray(wanted, float)[order]
    for number in range(len(placed) - 1, -1, -1):
        ceiling = high if number == len(placed) - 1 else placed[number + 1] - gap
        placed[number] = min(placed[number], ceiling)
    for number in range(len(placed)):
        floor = low if number == 0 else placed[number - 1] + gap
        placed[number] = max(placed[number], floor)
    result = np.empty(len(placed), int)
    result[order] = np.round(placed)
    return result.tolist()


def _colors(count: int) -> list[tuple[int, int, int]]:
    """Return colours of evenly spread hues, light and dark by turns, BGR."""
    hsv = [(179 * number / max(count, 1), 220, 200 if number % 2 else 130) for number in range(count)]
    bgr = cv2.cvtColor(np.array([hsv], np.uint8), cv2.COLOR_HSV2BGR)[0]
    return [(int(b), int(g), int(r)) for b, g, r in bgr]


def _column(line: Line) -> Column:
    return COLUMNS[line.columns[0]]


def _legend(image: np.ndarray) -> None:
    for place, (color, text) in enumerate(((_GREY, "paper"), (_BLUE, "ours"))):
        x = WIDTH - 190 + 90 * place
        cv2.rectangle(image, (x, 18), (x + 16, 30), color, cv2.FILLED)
        _text(image, text, (x + 22, 29))


def _text(
    image: np.ndarray,
    text: str,
    at: tuple[int, int],
    *,
    size: float = 0.48,
    bold: bool = False,
    color: tuple[int, int, int] = _INK,
) -> None:
    # OpenCV's letters are ASCII's.
    plain = text.encode("ascii", "replace").decode()
    cv2.putText(image, plain, at, cv2.FONT_HERSHEY_SIMPLEX, size, color, 2 if bold else 1, cv2.LINE_AA)
