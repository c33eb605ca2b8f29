"""How a model was trained: its run's config, and what the log comes to in one line."""

import json
from pathlib import Path
from typing import Any, NamedTuple

_METRICS, _CONFIG = "metrics.jsonl", "train_config.json"
"""As `poem train` writes them."""


class Training(NamedTuple):
    """How a model was trained, as far as that is known."""

    summary: str = ""
    """Steps, errors on the first and the last training samples, and hours."""
    config: str = ""
    """The run's config file: every field by its dotted name."""


def training_of(run: Path) -> Training:
    """Read the folder of a run; nothing where there is none.

    Args:
        run: folder of `poem train`. Steps that were taken again after a stop count once, in hours as well.
    """
    config = run / _CONFIG
    return Training(_summary(run / _METRICS), config.read_text(encoding="utf-8") if config.is_file() else "")


def _summary(file: Path) -> str:
    if not file.is_file():
        return ""
    lines = map(_entry, file.read_text(encoding="utf-8").splitlines())
    by_step = {line["step"]: line for line in lines if line.get("group") == "train"}
    if not by_step:
        return ""
    steps = sorted(by_step)
    seconds = sum(
        (step - before) / by_step[step]["steps_per_second"]
        for before, step in zip([0, *steps], steps, strict=False)
    )
    first, last = (by_step[step]["mpvpe_mm"] for step in (steps[0], steps[-1]))
    return f"{steps[-1]} steps, training MPVPE {first:.0f} to {last:.1f} mm, {seconds / 3600:.1f} h"


def _entry(text: str) -> dict[str, Any]:
    """Read a line; nothing where it is cut, as by a run that is still writing or was killed."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return {}
