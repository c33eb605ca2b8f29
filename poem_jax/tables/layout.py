"""A table as Markdown, in the paper's layout with the paper's number beside ours, and as JSON."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from poem_jax.evaluation.tables import ABSENT, PAPER_COLUMNS, Column
from poem_jax.io.atomic import whole_file
from poem_jax.tables.result import Line, TableResult

COLUMNS = {
    column.metric: column
    for column in (
        *PAPER_COLUMNS,
        Column("AUC-J", "pa_auc_j_50", 3),
        Column("AUC-V", "pa_auc_v_50", 3),
        Column("F@5", "pa_f_5", 3),
        Column("F@15", "pa_f_15", 3),
    )
}
"""How a metric is called and rounded."""
_LEGEND = (
    "Ours, and in brackets the paper's. Lengths in mm; AUC and F in 0..1. ± is the standard error over the "
    "samples of the first column. A dash: no number."
)


def as_markdown(result: TableResult, picture: str | None = None) -> str:
    """Write a table, how each line was scored, and what is missing of those that did not run.

    Args:
        result: the table.
        picture: file name of its picture, to be shown; None = there is none.
    """
    parts = [f"# {result.title}", "", _LEGEND, ""]
    for group, lines in groupby(result.lines, key=lambda line: (line.group, line.columns)):
        parts += [*_group(group[0], list(lines)), ""]
    if picture is not None:
        parts += [f"![The numbers of the table]({picture})", ""]
    parts += [f"{note}\n" for note in result.notes]
    parts += [*_how(result.lines), *_absent(result.lines)]
    return "\n".join(parts).rstrip() + "\n"


def as_json(result: TableResult) -> dict[str, Any]:
    """Return what `as_markdown` writes, for programs; a number that there is not is None."""
    return {
        "table": result.name,
        "title": result.title,
        "notes": list(result.notes),
        "files": list(result.files),
        "rows": [
            {
                "number": line.number,
                "data": line.group,
                "label": line.label,
                "columns": list(line.columns),
                "paper": dict(line.paper),
                "ours": None if line.ours is None else _numbers(line.ours),
                "standard_error": _numbers(line.spread),
                "samples": line.samples,
                "views": line.num_views,
                "beside": dict(line.beside),
                "degrade_percent": _degrade(line, result.lines),
                "how": dict(line.what),
                "notes": list(line.notes),
                "absent": list(line.absent),
            }
            for line in result.lines
        ],
    }


def write_table(folder: str | os.PathLike, result: TableResult, picture: str | None = None) -> list[str]:
    """Write `NAME.md` and `NAME.json` into a folder; return their paths."""
    paths = [os.path.join(folder, f"{result.name}.{suffix}") for suffix in ("md", "json")]
    with whole_file(paths[0]) as file:
        file.write_text(as_markdown(result, picture), encoding="utf-8")
    write_json(paths[1], result)
    return paths


def write_json(path: str | os.PathLike, result: TableResult) -> None:
    """Write `as_json`; the file appears whole or not at all."""
    with whole_file(path) as file:
        file.write_text(json.dumps(as_json(result), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def degrade_percent(numbers: Mapping[str, float], base: Mapping[str, float]) -> dict[str, float]:
    """Return by how much each error is larger than that of the base, in percent of the base."""
    return {name: 100 * (numbers[name] / base[name] - 1) for name in numbers if base.get(name)}


def _group(title: str, lines: Sequence[Line]) -> list[str]:
    """Write the lines of one data set under their own head."""
    columns = [COLUMNS[name] for name in lines[0].columns]
    beside = list(dict.fromkeys(name for line in lines for name in line.beside))
    head = ["#", "method", *(column.title for column in columns), "±", "samples", *beside]
    printed = {column.metric: _printed_decimals(lines, column) for column in columns}
    rows = []
    for line in lines:
        ours = line.ours or {}
        cells = [
            _cell(ours.get(c.metric), line.paper.get(c.metric), c.decimals, printed[c.metric])
            for c in columns
        ]
        error = line.spread.get(columns[0].metric)
        spread = ABSENT if error is None or math.isnan(error) else f"{error:.{columns[0].decimals}f}"
        number = "" if line.number is None else str(line.number)
        count = ABSENT if line.samples is None else str(line.samples)
        rows.append(
            [number, line.label, *cells, spread, count, *(line.beside.get(name, "") for name in beside)]
        )
        degrade = _degrade(line, lines)
        if degrade is not None:
            ours, paper = degrade["ours"], degrade["paper"]
            cells = [_cell(ours.get(c.metric), paper.get(c.metric), 0, 0) for c in columns]
            rows.append(["", "% degrade", *cells, "", "", *[""] * len(beside)])
    return [f"## {title}", "", *_markdown_rows(head, rows)]


def _degrade(line: Line, lines: Sequence[Line]) -> dict[str, dict[str, float | None]] | None:
    """Return by how much ours and the paper's errors are larger than those of the line that it names, which
    stands in the same group."""
    base = next((one for one in lines if (one.group, one.label) == (line.group, line.against)), None)
    if base is None:
        return None
    ours, paper = degrade_percent(line.ours or {}, base.ours or {}), degrade_percent(line.paper, base.paper)
    return {"ours": _numbers(ours), "paper": _numbers(paper)}


def _printed_decimals(lines: Sequence[Line], column: Column) -> int:
    """Return how many decimals the paper prints in a column: those of its longest number, since a number has
    lost its last zeros."""
    numbers = [line.paper[column.metric] for line in lines if column.metric in line.paper]
    return max((len(f"{number:.3f}".rstrip("0").partition(".")[2]) for number in numbers), default=0)


def _cell(ours: float | None, paper: float | None, decimals: int, printed: int) -> str:
    own = ABSENT if ours is None else f"{ours:.{decimals}f}"
    return own if paper is None else f"{own} ({paper:.{printed}f})"


def _markdown_rows(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    cells = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(text.replace("|", "\\|") for text in row) + " |" for row in cells]


def _how(lines: Sequence[Line]) -> list[str]:
    # One that ran and found no hand has no number, and its notes say so.
    scored = [line for line in lines if line.samples is not None]
    if not scored:
        return []
    names = list(dict.fromkeys(name for line in scored for name in line.what))
    rows = [
        [_name(line), *(line.what.get(name, "") for name in names), "; ".join(line.notes)] for line in scored
    ]
    return ["## How each row was scored", "", *_markdown_rows(["row", *names, "notes"], rows), ""]


def _absent(lines: Sequence[Line]) -> list[str]:
    """List the lines that did not run by what they lack, so that each need is said once."""
    needs: dict[str, list[str]] = {}
    for line in lines:
        for need in line.absent:
            needs.setdefault(need, []).append(_name(line))
    if not needs:
        return []
    return [
        "## What is missing",
        "",
        *(f"- {need}\n  (for {', '.join(dict.fromkeys(names))})" for need, names in needs.items()),
    ]


def _name(line: Line) -> str:
    return f"{line.group}: {line.label}"


def _numbers(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in values.items()}
