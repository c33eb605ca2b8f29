"""Tables as Markdown, JSON and pictures, from lines with known numbers."""

import json
import re

import cv2
import numpy as np
import pytest

from poem_jax.tables.all_tables import TABLES
from poem_jax.tables.layout import COLUMNS, as_json, as_markdown, degrade_percent, write_table
from poem_jax.tables.picture import curves_of, draw_table, spread_out, write_picture
from poem_jax.tables.result import Line, TableResult
from poem_jax.tables.row import SHORT
from poem_jax.tables.table import Table


def line(label: str, paper=(), ours=(), **fields) -> Line:
    numbers = dict(zip(SHORT, map(float, ours), strict=False)) or None
    return Line("Set-Mv", label, SHORT, dict(zip(SHORT, map(float, paper), strict=False)), numbers, **fields)


RESULT = TableResult(
    "mini",
    "A small table",
    (
        line(
            "base",
            (6.5, 4, 5, 3),
            (7.25, 5, 6, 4),
            spread={"mpvpe_mm": 0.125},
            samples=31,
            num_views=8,
            series="s",
        ),
        line("shuffled", (12, 8, 5, 3), (14.5, 5, 6, 4), against="base", num_views=2, series="s"),
        line("absent", (9, 4, 5, 3), absent=("put it there",)),
        line("absent too", (), absent=("put it there",), notes=("a note",)),
        line("found nothing", samples=0, notes=("3 samples in no mean",)),
    ),
)


def rows_of(text: str) -> dict[str, list[str]]:
    cells = [re.split(r" *\| *", row)[1:-1] for row in text.splitlines() if row.startswith("|")]
    return {row[1]: row for row in cells}


def test_markdown_has_the_papers_number_beside_ours() -> None:
    text = as_markdown(RESULT)
    rows = rows_of(text)
    assert rows["method"][2:6] == ["MPVPE", "PA-V", "MPJPE", "PA-J"]
    assert rows["base"][2:] == ["7.25 (6.5)", "5.00 (4)", "6.00 (5)", "4.00 (3)", "0.12", "31"]
    assert rows["% degrade"][2:4] == ["100 (85)", "0 (100)"]
    assert rows["absent"][2] == "- (9.0)"
    assert rows["absent too"][2] == "-"
    assert text.count("put it there") == 1
    assert "3 samples in no mean" in text
    assert "a note" not in text
    assert "Set-Mv: absent, Set-Mv: absent too" in text


def test_json_has_every_number_and_what_is_missing(tmp_path) -> None:
    nan = RESULT._replace(lines=(RESULT.lines[0]._replace(spread={"mpvpe_mm": float("nan")}),))
    assert as_json(nan)["rows"][0]["standard_error"] == {"mpvpe_mm": None}
    paths = write_table(tmp_path, RESULT, "mini.png")
    assert [path.rpartition("/")[2] for path in paths] == ["mini.md", "mini.json"]
    rows = json.loads((tmp_path / "mini.json").read_text())["rows"]
    assert rows[0]["ours"]["mpvpe_mm"] == 7.25
    assert rows[0]["paper"]["mpvpe_mm"] == 6.5
    assert rows[0]["degrade_percent"] is None
    assert rows[1]["degrade_percent"]["ours"]["mpvpe_mm"] == 100
    assert rows[1]["degrade_percent"]["paper"]["pa_mpvpe_mm"] == 100
    assert rows[2]["ours"] is None
    assert rows[2]["absent"] == ["put it there"]
    assert "](mini.png)" in (tmp_path / "mini.md").read_text()


def test_degradation_is_the_increase() -> None:
    assert degrade_percent({"mpvpe_mm": 20.40}, {"mpvpe_mm": 6.13})["mpvpe_mm"] == 100 * (20.40 - 6.13) / 6.13
    assert degrade_percent({"mpvpe_mm": 1.0}, {}) == {}


def test_a_picture_has_a_bar_as_long_as_its_number(tmp_path) -> None:
    image = draw_table(RESULT)
    blue = (image == (30, 110, 190)).all(-1)[: 44 + 34 * 5]
    bars = [int(row.sum()) for row in blue if row.sum() > 100]
    assert len(set(bars)) == 2
    assert max(bars) / min(bars) == pytest.approx(2, rel=0.01)
    write_picture(tmp_path / "mini.png", RESULT)
    written = cv2.imread(str(tmp_path / "mini.png"))
    np.testing.assert_array_equal(written[..., ::-1], image)


def test_curves_are_of_series_with_two_numbers_of_views() -> None:
    curves = curves_of(RESULT.lines)
    assert list(curves) == ["s"]
    assert curves["s"]["ours"] == [(2, 14.5), (8, 7.25)]
    assert curves["s"]["paper"] == [(2, 12), (8, 6.5)]
    assert curves_of(RESULT.lines[:1]) == {}


def test_every_row_of_the_paper_can_be_laid_out() -> None:
    of_rows = [table for table in TABLES.values() if isinstance(table, Table)]
    assert len(of_rows) == len(TABLES) - 1  # the synthetic one, which the paper has not
    for table in of_rows:
        for row in table.rows:
            assert set(row.columns) <= set(COLUMNS)
        labels = [(row.data.title, row.label) for row in table.rows]
        assert len(set(labels)) == len(labels)
        for row in table.rows:
            assert row.against is None or (row.data.title, row.against) in labels


_NUMBER, _NONE = r"\d+\.\d+", ("-", "–")


@pytest.mark.parametrize(
    ("name", "label", "columns"),
    [
        ("main", "table:quantitative", 8),
        ("ablation", "tab:ablation", 8),
        ("v2", "table:poemg_quantitative", 8),
        ("robustness", "tab:robustness", 4),
        ("ho3d-v2", "tab:ho3d_eval", 6),
        ("ho3d-v3", "tab:ho3dv3_eval", 6),
        ("real-world", "tab:realworld", 4),
    ],
)
def test_numbers_are_the_papers(shared_dir, name, label, columns) -> None:
    """Every row of the paper's table has the numbers of one of ours, and no other."""
    text = (shared_dir / "reference" / "paper.tex").read_text()
    start = text.index("\\label{" + label + "}")
    body = text[start : text.index("\\end{tabular}", start)]
    printed = []
    for row in re.sub(r"\\textbf\{([^{}]*)\}", r"\1", body).split("\\\\"):
        cells = [cell.strip() for cell in row.split("&")[-columns:]]
        if len(cells) == columns and all(re.fullmatch(_NUMBER, one) or one in _NONE for one in cells):
            printed.append(tuple(None if one in _NONE else float(one) for one in cells))
    table = TABLES[name]
    assert isinstance(table, Table)
    assert [row.printed for row in table.rows if row.printed] == printed


def test_the_single_views_numbers_are_the_papers(shared_dir) -> None:
    text = (shared_dir / "reference" / "paper.tex").read_text()
    found = re.search(rf"PA-MPJPE of ({_NUMBER}) mm and a PA-MPVPE of ({_NUMBER}) mm", text)
    assert found is not None
    table = TABLES["single-view"]
    assert isinstance(table, Table)
    assert table.rows[0].columns == ("pa_mpjpe_mm", "pa_mpvpe_mm")
    assert table.rows[0].printed == tuple(map(float, found.groups()))


def test_names_of_curves_keep_apart_in_their_order():
    assert spread_out([10, 200, 100], 16, 0, 300) == [10, 200, 100]
    crowded = spread_out([50, 52, 51, 300, 299], 16, 40, 300)
    assert sorted(crowded) == [crowded[i] for i in (0, 2, 1, 4, 3)]
    assert min(np.diff(sorted(crowded))) >= 16
    assert min(crowded) >= 40
    assert max(crowded) <= 300
    assert spread_out([5] * 3, 16, 0, 20) == [0, 16, 32]
