"""What a training log comes to, in one line."""

import json
from pathlib import Path
from typing import Any

_METRICS = "metrics.jsonl"
"""As `poem train` writes it."""


def training_summary(run: Path) -> str:
    """Return steps, errors on the first and the last training samples and hours; "" where there is no log.

    Args:
        run: folder of `poem train`. Steps that were taken again after a stop count once, in hours as well.
    """
    file = run / _METRICS
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
