"""Which checkpoints of a run are kept: the newest ones, and the best one where it is asked for."""

import json
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json
from poem_jax.training.config import TrainConfig

_log = logging.getLogger(__name__)


def what_is_scored(config: TrainConfig) -> str:
    """Return the held-out samples on which `Validation.score` rests, in words: scores of others do not
    compare."""
    run, parts = config.train, () if config.data.mixture is None else config.data.mixture.parts
    held_out = [f"{number}: {part.held_out:g}" for number, part in enumerate(parts) if part.held_out]
    if held_out:
        most = max(shape.num_views for shape in config.data.batches)
        return f"{run.validation_samples} frames of parts {', '.join(held_out)}, up to {most} views"
    views = ", ".join(map(str, run.validation_views))
    return f"{run.validation_samples} synthetic samples of {views} views, seed {run.validation_seed}"


class Scores:
    """The vertex errors in validation of a run's checkpoints, in a file of their own.

    Validation may change from one sitting to the next, so scores are told apart by what was validated on
    (`what_is_scored`), and only like ones are compared.

    Not among a checkpoint's own files, since Orbax reads those of all checkpoints when it opens a run: one
    that is damaged would close the whole run.
    """

    def __init__(self, file: Path, samples: str | None) -> None:
        """Read the file.

        Args:
            file: JSON; may be missing.
            samples: what is validated on; None = what the newest score of the file rests on.
        """
        self._file = file
        self._all = _read(file)
        self._samples = next(reversed(self._all), "") if samples is None else samples
        if self._all and self._samples not in self._all:
            _log.warning(
                "validation is now on %s; scores of other samples do not count: %s",
                self._samples,
                "; ".join(self._all),
            )

    def note(self, step: int, score: float | None, *, write: bool) -> None:
        """Remember the score of a step, or that it has none; `write` it for the next sitting."""
        for scores in self._all.values():
            scores.pop(step, None)
        if score is not None and math.isfinite(score):
            # The newest come last.
            self._all[self._samples] = {**self._all.pop(self._samples, {}), step: float(score)}
        if write and (self._all or self._file.exists()):
            with whole_file(self._file) as file:
                file.write_text(json.dumps(self._all, indent=1) + "\n", encoding="utf-8")

    def best_of(self, steps: Sequence[int]) -> int | None:
        """Return the step with the least score, the newest of equal ones; None where none has a score."""
        return _best(steps, self._all.get(self._samples, {}))

    def all_best_of(self, steps: Sequence[int]) -> set[int]:
        """Return the best step by each kind of samples that was validated on: what changed is no reason to
        remove a checkpoint."""
        return {best for scores in self._all.values() if (best := _best(steps, scores)) is not None}


class NewestAndBest:
    """Tells Orbax which checkpoints to keep: the newest `newest`, and the best if asked for."""

    def __init__(self, newest: int, scores: Scores, *, best: bool) -> None:
        self._newest, self._scores, self._best = newest, scores, best

    def should_preserve(self, checkpoints: Sequence[Any], *, context: Any) -> list[bool]:
        """Say for each checkpoint, the oldest first, whether it stays."""
        steps = [checkpoint.step for checkpoint in checkpoints]
        kept = set(sorted(steps)[-self._newest :])
        if self._best:
            kept |= self._scores.all_best_of(steps)
        return [step in kept for step in steps]


def _best(steps: Sequence[int], scores: Mapping[int, float]) -> int | None:
    known = [step for step in steps if step in scores]
    return min(known, key=lambda step: (scores[step], -step), default=None)


def _read(file: Path) -> dict[str, dict[int, float]]:
    if not file.is_file():
        return {}
    try:
        return {
            samples: {int(step): float(score) for step, score in scores.items()}
            for samples, scores in read_json(file).items()
            if scores
        }
    except (ValueError, TypeError, AttributeError) as error:
        _log.warning("%s cannot be read (%s); which checkpoint is the best is found anew", file, error)
        return {}
