"""Steps whose numbers are not finite: what is kept of them, how many may be left out, and what ends the run.

A batch is a pure function of its step, so that the one of a bad step is drawn once more, for a look at it.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.io.atomic import whole_file
from poem_jax.mixture.stream import host_rows
from poem_jax.training.config import DataConfig
from poem_jax.training.pictures import image_grid, write_png
from poem_jax.training.source import BatchAt
from poem_jax.weights.store import flatten

MARK = "bad_step"
"""Metric of a step whose update was left out: 1, else 0."""
_MOST_KEPT = 8
"""Batches that a sitting writes; the steps of more are named in the log alone."""
_MOST_ROWS = 16
"""Samples in the picture of a batch."""

_MOST_NAMED = 8
"""Samples whose keys a message gives."""

StepMetrics = Mapping[str, float]

log = logging.getLogger(__name__)


@dataclass
class BadSteps:
    """Watches the metrics of a sitting."""

    run_dir: Path
    allowed: int
    """Steps that may be left out (`train.skip_bad_steps`)."""
    draw: BatchAt
    positions: Callable[[int, int], Sequence[int]] | None = None
    """From a step and a number of rows to the samples' positions in their source; None = it has none."""
    key_at: Callable[[int, int], str] | None = None
    """From such a position and the batch's number of views to how the user knows the sample."""
    left_out: list[int] = field(default_factory=list)
    """The steps that were left out, counted from 0."""

    def check(self, fetched: Sequence[tuple[int, StepMetrics]]) -> list[StepMetrics]:
        """Return the metrics of the good steps, and deal with the others.

        Args:
            fetched: steps, counted from 0, and their metrics.

        Raises:
            FloatingPointError: a step's numbers are not finite and went into the weights, or more steps were
                left out than may be. Names the step and its samples, and where its batch is.
        """
        good = []
        for step, metrics in fetched:
            bad = {name: float(value) for name, value in metrics.items() if not math.isfinite(value)}
            if metrics.get(MARK, 0):
                self._leave_out(step, bad)
            elif bad:
                remedy = "" if MARK in metrics else "; `train.skip_bad_steps` leaves such steps out"
                raise FloatingPointError(
                    f"training stopped: {bad} at step {step}{self._kept(step)}. The newest checkpoint is "
                    f"from before, and the same command goes on from there{remedy}"
                )
            else:
                good.append({name: value for name, value in metrics.items() if name != MARK})
        return good

    def _leave_out(self, step: int, bad: Mapping[str, float]) -> None:
        self.left_out.append(step)
        what = f"{bad or 'a gradient or statistic that is not finite'} at step {step}"
        if len(self.left_out) > self.allowed:
            raise FloatingPointError(
                f"training stopped: {what}{self._kept(step)}. It is bad step {len(self.left_out)} of this "
                f"sitting, and `train.skip_bad_steps` allows {self.allowed}; the newest checkpoint is from "
                "before the last of them"
            )
        kept = self._kept(step) if len(self.left_out) <= _MOST_KEPT else ""
        log.warning("left out: %s%s", what, kept)

    def _kept(self, step: int) -> str:
        """Write the batch of a step, and say what it is and where."""
        batch = self.draw(step)
        rows = len(batch.views)
        samples = None if self.positions is None else list(self.positions(step, rows))
        names = range(rows) if samples is None else samples
        of = "" if samples is None else f" (samples {_listed(samples)} of the source)"
        host = f"_host{jax.process_index()}" if jax.process_count() > 1 else ""
        file = self.run_dir / f"bad_step_{step}{host}.npz"
        try:
            with whole_file(file) as temporary:
                arrays = {name: np.asarray(leaf) for name, leaf in flatten(batch).items()}
                np.savez_compressed(temporary, **arrays, samples=np.asarray(names))  # pyright: ignore[reportArgumentType]
            write_png(file.with_suffix(".png"), image_grid(batch.views, rows=_MOST_ROWS))
        except OSError as error:
            place = f"the batch could not be saved ({error})"
        else:
            place = f"the batch is in {file}, its images in {file.with_suffix('.png').name}"
        return f"{of}; {place}; {_cause(batch, names, self.key_at)}"


def positions_in(config: DataConfig) -> Callable[[int, int], Sequence[int]]:
    """Return the function from a step and the number of this host's rows to the samples' positions in the
    source of the config: synthetic captures, or the stream of a mixture."""
    largest = max(shape.batch_size for shape in config.batches)
    host, hosts = jax.process_index(), jax.process_count()
    return lambda step, rows: host_rows(step, rows * hosts, largest, host=host, hosts=hosts)


def _cause(batch: MultiViewBatch, names: Sequence[int], key_at: Callable[[int, int], str] | None) -> str:
    """Say which arrays of which samples are not finite, or that it is not the data."""
    found, wrong = [], set()
    for name, leaf in flatten(batch).items():
        array = np.asarray(leaf)
        if np.issubdtype(array.dtype, np.floating):
            finite = np.isfinite(array).reshape(len(array), -1).all(1)
            rows = [names[int(row)] for row in np.flatnonzero(~finite)]
            found += [f"{name} of sample {_listed(rows)}"] if rows else []
            wrong |= {*rows}
    if found:
        first = sorted(wrong)[:_MOST_NAMED] if key_at else []
        keys = ", ".join(f"{row} is {key_at(row, batch.views.shape[1])}" for row in first if key_at)
        more = f", and {len(wrong) - len(first)} more" if first and len(first) < len(wrong) else ""
        return f"its data are not finite: {', '.join(found)}" + (f"; sample {keys}{more}" if keys else "")
    return "its data are finite, so lower the learning rate"


def _listed(numbers: Sequence[int]) -> str:
    """Write numbers shortly: `3`, `24 to 31`, `3, 5, 9`."""
    first, last = numbers[0], numbers[-1]
    if len(numbers) > 2 and list(numbers) == list(range(first, last + 1)):
        return f"{first} to {last}"
    return ", ".join(map(str, numbers))
