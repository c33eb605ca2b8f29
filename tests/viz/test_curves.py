"""Curves as SVG: what is drawn lies where the axes say, and nothing else is needed to see it."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from poem_jax.viz.curves import Curve, figure


def draw(*curves, **labels):
    text = figure("T", curves, **({"x_label": "step", "y_label": "mm"} | labels))
    return text, ElementTree.fromstring(text)


def polylines(root):
    return [
        np.array([pair.split(",") for pair in line.get("points").split()], float)
        for line in root.iter("polyline")
    ]


def ticks(root, anchor):
    """Return places and texts of an axis' ticks."""
    axis = "x" if anchor == "middle" else "y"
    found = [t for t in root.iter("text") if t.get("text-anchor") == anchor and re.match(r"[-\d]", t.text)]
    return [(float(t.get(axis)), t.text) for t in found]


@pytest.mark.parametrize(
    "y", [np.linspace(3.0, 47.0, 20), np.linspace(-2.0, 1.0, 20), np.geomspace(1e-5, 10.0, 20)]
)
def test_points_lie_where_the_ticks_say(y):
    x = np.linspace(0, 95, 20)
    _, root = draw(Curve("a", x, y), may_be_log=True)
    (points,) = polylines(root)
    marks = [(place - 4, float(text)) for place, text in ticks(root, "end")]
    assert len(marks) >= 3
    log = y.min() > 0 and y.max() > 30 * y.min()
    places, values = (np.array(both) for both in zip(*marks, strict=True))
    slope, offset = np.polyfit(np.log(values) if log else values, places, 1)
    np.testing.assert_allclose(points[:, 1], slope * (np.log(y) if log else y) + offset, atol=0.3)
    across = [(place, float(text)) for place, text in ticks(root, "middle")]
    slope, offset = np.polyfit(*zip(*[(v, p) for p, v in across], strict=True), 1)
    np.testing.assert_allclose(points[:, 0], slope * x + offset, atol=0.3)


def test_labels_say_units_and_text_is_escaped():
    text, root = draw(Curve("a<b", np.arange(3), np.arange(3)), y_label="error & more, mm")
    words = [t.text for t in root.iter("text")]
    assert "step" in words
    assert "error & more, mm" in words
    assert "a&lt;b" in text
    assert not re.search(r"https?:|<script|<link|url\(", text)
    wide = Curve("a", np.arange(1, 4), np.array([1.0, 10.0, 100.0]))
    assert "mm, logarithmic" in draw(wide, may_be_log=True)[0]
    assert "logarithmic" not in draw(wide)[0]


def test_a_long_curve_is_averaged_to_few_points():
    x = np.arange(100_000)
    _, root = draw(Curve("a", x, np.sin(x) + x / 1e5))
    (points,) = polylines(root)
    assert len(points) == 300
    assert np.all(np.diff(points[:, 1]) < 0.05)


@pytest.mark.parametrize(
    "y",
    [[5.0, 5.0], [0.0, 0.0], [1e-9, 1e-9], [-3.0, -3.0], [1e308, 1e308], [5e-324, 5e-324], [1.0, 1 + 2e-16]],
)
def test_a_constant_has_an_axis(y):
    _, root = draw(Curve("a", np.array([1, 2]), np.array(y)))
    (points,) = polylines(root)
    assert np.isfinite(points).all()
    assert np.ptp(points[:, 1]) == 0


@pytest.mark.parametrize("may_be_log", [True, False])
@pytest.mark.parametrize(
    "y", [[1e308, -1e308, np.nan], [1e308, 5e-324, 1.0], [1e308, 1e-290, 1.0], [5e-324, 1e-323, 1e-310]]
)
def test_the_largest_and_smallest_numbers_are_drawn(y, may_be_log):
    """Also many of them, whose sum no number holds."""
    many = np.tile(y, 1000)
    curves = (Curve("a", np.arange(3), np.array(y)), Curve("b", np.arange(3000), many))
    text, root = draw(*curves, may_be_log=may_be_log)
    assert all(np.isfinite(points).all() for points in polylines(root))
    assert not re.search("nan|inf", text)
    assert len({word for _, word in ticks(root, "end")}) >= 2


def test_what_is_not_finite_is_left_out():
    values = np.array([1.0, np.nan, 2.0, np.inf])
    _, root = draw(Curve("a", np.arange(4), values), Curve("b", np.arange(1), values[:1]))
    assert [len(points) for points in polylines(root)] == [2]
    assert len(list(root.iter("circle"))) == 1
    with pytest.raises(ValueError, match="'T' needs a finite value"):
        draw(Curve("a", np.arange(1), np.array([np.nan])))
