"""Which checkpoints of a run are kept: the newest ones, and the best one where it is asked for."""

import json
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json

_log = logging.getLogger(__name__)


class Scores:
    """The vertex errors in validation of a run's checkpoints, in a file of their own.

    Not among a checkpoint's own files, since Orbax reads those of all checkpoints when it opens a run: one
    that is damaged would close the whole run.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._of_steps = _read(file)

    def note(self, step: int, score: float | None, *, write: bool) -> None:
        """Remember the score of a step, or that it has none; `write` it for the next sitting."""
        self._of_steps.pop(step, None)
        if score is not None and math.isfinite(score):
            self._of_steps[step] = float(score)
        if write and (self._of_steps or self._file.exists()):
            with whole_file(self._file) as file:
                file.write_text(json.dumps(self._of_steps, indent=1) + "\n", encoding="utf-8")

    def best_of(self, steps: Sequence[int]) -> int | None:
        """Return the step with the least score, the newest of equal ones; None where none has a score."""
        known = [step for step in steps if step in self._of_steps]
        return min(known, key=lambda step: (self._of_steps[step], -step), default=None)


class NewestAndBest:
    """Tells Orbax which checkpoints to keep: the newest `newest`, and the best if asked for."""

    def __init__(self, newest: int, scores: Scores, *, best: bool) -> None:
        self._newest, self._scores, self._best = newest, scores, best

    def should_preserve(self, checkpoints: Sequence[Any], *, context: Any) -> list[bool]:
        """Say for each checkpoint, the oldest first, whether it stays."""
        steps = [checkpoint.step for checkpoint in checkpoints]
        kept = set(sorted(steps)[-self._newest :])
        if self._best:
            kept.add(self._scores.best_of(steps))
        return [step in kept for step in steps]


def _read(file: Path) -> dict[int, float]:
    if not file.is_file():
        return {}
    try:
        return {int(step): float(score) for step, score in read_json(file).items()}
    except (ValueError, TypeError, AttributeError) as error:
        _log.warning("%s cannot be read (%s); which checkpoint is the best is found anew", file, error)
        return {}
