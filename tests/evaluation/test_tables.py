import json

import pytest

from poem_jax.evaluation.tables import Column, format_report, format_table, write_json

RESULTS = {
    1: {"mpvpe_mm": 20.0, "dlt_2px_root_error_mm": None, "unsolved": 0},
    8: {"mpvpe_mm": 7.125, "dlt_2px_root_error_mm": 3.3, "unsolved": 2},
}


def test_table_is_aligned_and_marks_what_is_absent() -> None:
    columns = [Column("MPVPE", "mpvpe_mm"), Column("DLT", "dlt_2px_root_error_mm", 1), Column("F@5", "f_5")]
    assert format_table(RESULTS, columns).splitlines() == [
        "views  MPVPE  DLT",
        "-----------------",
        "   1*  20.00    -",
        "    8   7.12  3.3",
    ]


def test_report_explains_the_row_of_one_view() -> None:
    assert "the true one is given" in format_report(RESULTS)
    assert "the true one is given" not in format_report({8: RESULTS[8]})


def test_report_says_which_joints_are_compared() -> None:
    assert "not joints regressed from its vertices" in format_report(RESULTS)


def test_json_is_by_view_count(tmp_path) -> None:
    path = tmp_path / "new" / "r.json"
    write_json(path, RESULTS)
    assert json.loads(path.read_text()) == {str(n): scores for n, scores in RESULTS.items()}


def test_json_refuses_nan_and_leaves_no_file(tmp_path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "r.json", {8: {"mpvpe_mm": float("nan")}})
    assert list(tmp_path.iterdir()) == []
