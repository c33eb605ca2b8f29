"""Any model on any source of frames, as a table of one line: `poem eval --dataset PATH --checkpoint DIR`."""

from dataclasses import replace
from pathlib import Path

from poem_jax.data.frames import FrameSource
from poem_jax.data.view_sampling import cameras_in_words
from poem_jax.evaluation.dataset import SetSettings, score_set
from poem_jax.evaluation.systems import Network
from poem_jax.mixture.recognise import Kind, recognise, source_at
from poem_jax.tables.result import Line, TableResult
from poem_jax.tables.row import AT_20_MM, AT_50_MM, OFFICIAL
from poem_jax.tables.run import notes_of, root_in_words
from poem_jax.weights.store import SHIPPED, load

_COLUMNS = (*dict.fromkeys((*AT_20_MM, *AT_50_MM, "f_5", "f_15")),)
"""A column that the protocol lacks is left out."""
_VALIDATION = {Kind.ARCTIC: "val", Kind.INTERHAND: "val"}
"""Splits that stand for a test; the other sets have one."""


def open_path(path: str, kind: Kind | None, *, split: str | None, mano: Path | None) -> FrameSource:
    """Open a source to evaluate on.

    Args:
        path: tars, the folder of a raw set, or a labelled capture, of whose labels joints are enough.
        kind: which of these; None = it is found out.
        split: None = the paper's test split, or for tars what their names say.
        mano: the user's MANO file, where labels need one.

    Raises:
        FileNotFoundError: something is missing.
        ValueError: it is none of these, or damaged.
    """
    kind = recognise(path) if kind is None else kind
    if kind is Kind.CAPTURE:
        from poem_jax.data.sources.captures import Captures

        if split is not None:
            raise ValueError(f"a capture has no splits; got --split {split}")
        return Captures(path, mano=mano, joints_alone=True)
    if split is None and kind is not Kind.TARS:
        split = _VALIDATION.get(kind, "test")
    return source_at(path, kind, split=split, mano=mano).open()


def score_path(source: FrameSource, checkpoint: Path | None, settings: SetSettings) -> TableResult:
    """Score a model on a source; by the protocol of HO-3D every image counts, as in its official evaluation.

    Args:
        source: opened by `open_path`.
        checkpoint: the model's folder; None = the shipped weights.
        settings: cameras, protocol, sizes.

    Raises:
        FileNotFoundError, ValueError: no such model, or no sample can be used.
    """
    weights = SHIPPED if checkpoint is None else checkpoint
    settings = replace(settings, each_view=settings.each_view or settings.protocol == "ho3d")
    scores = score_set(Network(*load(weights)), source, settings)
    wanted = OFFICIAL if scores.protocol == "ho3d" else _COLUMNS
    columns = tuple(name for name in wanted if name in scores.rows)
    line = Line(
        group=source.name,
        label=str(weights),
        columns=columns or _COLUMNS[:1],
        paper={},
        ours=scores.means if scores.keys else None,
        spread=scores.standard_errors if scores.keys else {},
        samples=len(scores.keys),
        what={
            "cameras": cameras_in_words(settings.cameras),
            "protocol": scores.protocol,
            "root": root_in_words(scores),
        },
        notes=tuple(notes_of(scores)),
    )
    return TableResult("dataset", f"{weights} on {source.name}", (line,))
