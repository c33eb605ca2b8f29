"""Benchmark results as aligned text, in the columns of the paper's tables, and as JSON."""

import json
import os
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from poem_jax.evaluation.benchmark import Scores
from poem_jax.io.atomic import whole_file

ABSENT = "-"
GIVEN_ROOT_MARK = "*"


class Column(NamedTuple):
    """One column: what stands over it, the metric under it, and its decimals."""

    title: str
    metric: str
    decimals: int = 2


PAPER_COLUMNS = (
    Column("MPVPE", "mpvpe_mm"),
    Column("RR-V", "rr_mpvpe_mm"),
    Column("PA-V", "pa_mpvpe_mm"),
    Column("AUC-V@20", "auc_v_20", 3),
    Column("AUC-V@50", "auc_v_50", 3),
    Column("MPJPE", "mpjpe_mm"),
    Column("RR-J", "rr_mpjpe_mm"),
    Column("PA-J", "pa_mpjpe_mm"),
    Column("AUC-J@20", "auc_j_20", 3),
    Column("AUC-J@50", "auc_j_50", 3),
    Column("F@5", "f_5", 3),
    Column("F@15", "f_15", 3),
)
"""The paper's main table, its HO-3D columns, and F scores (not aligned)."""

STAGE_COLUMNS = (
    Column("mean", "mpvpe_mm"),
    Column("median", "median_mpvpe_mm"),
    Column("true root", "mpvpe_true_root_mm"),
    Column("RR-V", "rr_mpvpe_mm"),
    Column("PA-V", "pa_mpvpe_mm"),
    Column("root", "root_error_mm"),
    Column("DLT 2 px", "dlt_2px_root_error_mm"),
    Column("mean pose", "mean_pose_mpvpe_mm"),
    Column("turned", "mean_pose_rotated_mpvpe_mm"),
    Column("fit", "fit_mpvpe_mm"),
    Column("its median", "median_fit_mpvpe_mm"),
    Column("not fitted", "fit_unsolved", 0),
    Column("unsolved", "unsolved", 0),
)
"""Which stage fails: vertex errors with the model's and with the true root, the root's error, baselines."""

STAGE_LEGEND = """\
mean, median     MPVPE over the captures, and the median capture
true root        MPVPE with the true root joint given
RR-V, PA-V       MPVPE relative to the wrist, and after Procrustes alignment
root             error of the root joint that the model triangulates
DLT 2 px         error of the root triangulated from its true pixels with 2 px of noise
mean pose        baseline at the true root: the captures' mean mesh in the primary camera's frame
turned           baseline at the true root: their mean hand, turned by the true global rotation
fit, its median  baseline: the solver of `poem fit` on the key points of the model's own first stage; where
                 too few agree ("not fitted") the template posed by all of them"""
JOINTS_LEGEND = "joint columns: the 21 joints that the model predicts, not joints regressed from its vertices"
REGRESSED_LEGEND = "joint columns: joints regressed from the vertices of both sides; AUC-J: predicted joints"
GIVEN_ROOT_LEGEND = (
    f"{GIVEN_ROOT_MARK} one view does not fix the root: the true one is given to a model that takes one"
)


def format_report(results: Mapping[int, Scores], *, regressed_joints: bool = False) -> str:
    """Write both tables, with legends, one row per view count.

    Args:
        results: as `run_benchmark` returns them.
        regressed_joints: whether the protocol regresses joints from vertices.

    Returns: text without a final line break; lengths in millimetres.
    """
    parts = [
        "Paper's columns (mm; AUC and F in 0..1)",
        format_table(results, PAPER_COLUMNS),
        REGRESSED_LEGEND if regressed_joints else JOINTS_LEGEND,
        "",
        "Which stage fails (MPVPE and root error, mm)",
        format_table(results, STAGE_COLUMNS),
        STAGE_LEGEND,
    ]
    return "\n".join(parts + ([GIVEN_ROOT_LEGEND] if 1 in results else []))


def format_table(results: Mapping[int, Scores], columns: Sequence[Column]) -> str:
    """Write one table; a metric that a view count lacks is a dash, and one that all lack gets no column."""
    present = [c for c in columns if any(scores.get(c.metric) is not None for scores in results.values())]
    header = ["views", *(column.title for column in present)]
    rows = [
        [_label(n), *(_cell(scores.get(column.metric), column.decimals) for column in present)]
        for n, scores in results.items()
    ]
    widths = [max(map(len, cells)) for cells in zip(header, *rows, strict=True)]
    lines = [_line(cells, widths) for cells in (header, *rows)]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def write_json(path: str | os.PathLike, results: Mapping[int, Scores]) -> None:
    """Write `{"8": {"mpvpe_mm": ...}, ...}` by view count; the file appears whole or not at all."""
    text = json.dumps({str(n): scores for n, scores in results.items()}, indent=2, allow_nan=False)
    with whole_file(path) as file:
        file.write_text(text + "\n", encoding="utf-8")


def _label(num_views: int) -> str:
    return f"{num_views}{GIVEN_ROOT_MARK}" if num_views == 1 else str(num_views)


def _cell(value: float | int | None, decimals: int) -> str:
    return ABSENT if value is None else f"{value:.{decimals}f}"


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "  ".join(cell.rjust(width) for cell, width in zip(cells, widths, strict=True))
