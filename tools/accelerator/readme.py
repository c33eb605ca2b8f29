"""The figures of a GPU as a table, and its place in README.md."""

from collections.abc import Iterable
from datetime import date
from pathlib import Path

from poem_jax.io.atomic import whole_file
from poem_jax.training.config import Rematerialise
from tools.accelerator.results import Figures, Results

BEGIN, END = "<!-- accelerator -->", "<!-- /accelerator -->"
NOT_MEASURED = "not measured"
NOTHING = Rematerialise.NOTHING.value


def rewrite(file: Path, table: str) -> None:
    """Put the table between the two marks of a Markdown file.

    Raises: ValueError: the marks are not there, once each and in order.
    """
    text = file.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(END) < text.index(BEGIN):
        raise ValueError(
            f"{file} must have the marks {BEGIN} and {END}, once each, for the table to stand in"
        )
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    with whole_file(file) as temporary:
        temporary.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}", encoding="utf-8")


def table(results: Results) -> str:
    """Return the table; cells that have no figures say so."""
    rows = [row for row in results.rows.values() if "problem" not in row]
    machine = results.machine
    title = "one GPU" if machine is None or not rows else f"{machine['device']}, {date.today().isoformat()}"
    lines = [f"| {title} | bfloat16 | float32 |", "|---|---|---|"]
    for views in (8, 4, 1):
        label = f"`v2-base`, {views} view{'s' * (views > 1)}: ms at batch 1; samples/s at the best batch"
        cells = [_inference(rows, "v2-base", precision, views) for precision in ("bfloat16", "float32")]
        lines.append(_line(label, cells))
    for model, what in (("v2-base", "1 to 8 views"), ("tiny", "1 to 4 views")):
        cells = [_training(rows, machine, model, precision) for precision in ("bfloat16", "float32")]
        lines.append(
            _line(
                f"training `{model}`, {what} a sample: samples/s at the best batch; share of the peak", cells
            )
        )
    fits = _best(_chosen(rows, what="fitting"), "fits_per_second")
    cell = NOT_MEASURED if fits is None else f"{fits['fits_per_second']:.0f}"
    lines.append(_line("`poem fit`'s solver, 4 views: fits/s", ["-", cell]))
    return "\n".join(lines)


def _inference(rows: list[Figures], model: str, precision: str, views: int) -> str:
    # By `infer` the images come from the host: other figures, which are in the results alone.
    known = {"what": "inference", "model": model, "precision": precision, "packed": False}
    measured = _chosen(rows, **known, views=views)
    alone = [row["ms"] for row in measured if row["batch"] == 1]
    best = _best(measured, "per_second")
    if best is None:
        return NOT_MEASURED
    first = f"{min(alone):.1f} ms" if alone else "-"
    return f"{first}; {best['per_second']:.0f}/s ({best['batch']})"


def _training(rows: list[Figures], machine: Figures | None, model: str, precision: str) -> str:
    best = _best(_chosen(rows, what="training", model=model, precision=precision), "samples_per_second")
    if best is None or machine is None:
        return NOT_MEASURED
    again = "" if best.get("rematerialise", NOTHING) == NOTHING else ", rematerialised"
    stated, of = machine[f"{precision}_peak_tflops"], "stated"
    if stated is None:
        stated, of = machine[f"{precision}_product_tflops"], "of a large product"
    share = f"{100 * best['tflops'] / stated:.0f} % of {stated:.3g} TFLOP/s {of}"
    return f"{best['samples_per_second']:.0f}/s at batch {best['batch']}{again}; {share}"


def _chosen(rows: list[Figures], **wanted: object) -> list[Figures]:
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def _best(rows: list[Figures], figure: str) -> Figures | None:
    return max(rows, key=lambda row: row[figure], default=None)


def _line(label: str, cells: Iterable[str]) -> str:
    return "| " + " | ".join([label, *cells]) + " |"
