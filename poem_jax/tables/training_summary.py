"""What a training log comes to, in one line."""

import json
from pathlib import Path

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
    lines = [json.loads(text) for text in file.read_text(encoding="utf-8").splitlines()]
    by_step = {line["step"]: line for line in lines if line["group"] == "train"}
    if not by_step:
        return ""
    steps = sorted(by_step)
    seconds = sum(
        (step - before) / by_step[step]["steps_per_second"]
        for before, step in zip([0, *steps], steps, strict=False)
    )
    first, last = (by_step[step]["mpvpe_mm"] for step in (steps[0], steps[-1]))
    return f"{steps[-1]} steps, {first:.0f} to {last:.1f} mm, {seconds / 3600:.1f} h"
