"""What of the data could not be used: `data_report.json` in the run's folder, and the limit that stops it."""

import json
import logging
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json
from poem_jax.mixture.samples import Drawn, LeftOut

LEAST_SAMPLES = 100
"""Before the share of corrupt ones counts."""
MOST_NAMED = 1000
"""Corrupt samples that the report and the log name, per sitting; all are counted."""
_PAUSE_S = 10.0

_log = logging.getLogger(__name__)


class TooManyCorruptSamples(ValueError):
    """More samples could not be used than the config allows."""


class DataReport:
    """Counts what one sitting of a run draws, a little ahead of its steps. Safe to share between threads."""

    def __init__(self, file: Path, names: Sequence[str], max_corrupt_share: float) -> None:
        """Begin a sitting's entry; those of earlier sittings stay.

        Raises:
            ValueError: the file there is no report.
        """
        self.file, self._names, self._limit = file, list(names), max_corrupt_share
        self._earlier = _sittings(file)
        self._drawn = [0] * len(self._names)
        self._corrupt = [0] * len(self._names)
        self._named: dict[tuple[int, str], str] = {}
        self._left_out: dict[str, LeftOut] = {}
        self._lock = threading.Lock()
        self._written_at = -_PAUSE_S

    def note_left_out(self, part: int, left_out: LeftOut) -> None:
        """Name what a source had to leave out when it was opened (shards cut off); it has logged that itself.

        Raises:
            TooManyCorruptSamples: it is more than the limit's share, of 100 or more.
        """
        if not left_out.problems:
            return
        name, all_samples = self._names[part], left_out.samples + left_out.lost
        self._left_out[name] = left_out
        self.write()
        if all_samples >= LEAST_SAMPLES and left_out.lost > self._limit * all_samples:
            raise TooManyCorruptSamples(
                f"about {left_out.lost} of {all_samples} samples of {name} had to be left out, more than "
                f"{self._limit_in_words()}: {left_out.problems[0]}. {self._remedy()}"
            )

    def note(self, drawn: Iterable[Drawn]) -> None:
        """Count samples and what was passed over for them.

        Raises:
            TooManyCorruptSamples: their share is above the limit, after 100 samples or more.
        """
        with self._lock:
            found = False
            for sample in drawn:
                self._drawn[sample.part] += 1
                for skipped in sample.skipped:
                    found = True
                    self._corrupt[skipped.part] += 1
                    self._name(skipped.part, skipped.key, skipped.problem)
            tried, corrupt = sum(self._drawn) + sum(self._corrupt), sum(self._corrupt)
            stop = tried >= LEAST_SAMPLES and corrupt > self._limit * tried
            if stop or (found and time.monotonic() - self._written_at > _PAUSE_S):
                self.write()
        if stop:
            raise TooManyCorruptSamples(
                f"{corrupt} of {tried} samples could not be used, more than {self._limit_in_words()}: "
                f"{self._worst()}. {self._remedy()}"
            )

    def write(self) -> None:
        """Write the file."""
        with whole_file(self.file) as file:
            file.write_text(json.dumps([*self._earlier, self._entry()], indent=1) + "\n", encoding="utf-8")
        self._written_at = time.monotonic()

    def _limit_in_words(self) -> str:
        return f"`mixture.max_corrupt_share` = {self._limit:g} allows"

    def _remedy(self) -> str:
        return f"{self.file} names them; mend those files or fetch them anew, or raise the share"

    def _name(self, part: int, key: str, problem: str) -> None:
        if (part, key) in self._named or len(self._named) >= MOST_NAMED:
            return
        self._named[part, key] = problem
        _log.warning("corrupt sample of %s passed over: %s", self._names[part], problem)

    def _entry(self) -> dict[str, Any]:
        return {
            "sources": {
                name: {
                    "samples": self._drawn[part],
                    "corrupt": self._corrupt[part],
                    "lost": self._lost(name).lost,
                    "left_out": self._lost(name).problems[:MOST_NAMED],
                    "corrupt_samples": {
                        key: problem for (of, key), problem in self._named.items() if of == part
                    },
                }
                for part, name in enumerate(self._names)
            }
        }

    def _lost(self, name: str) -> LeftOut:
        return self._left_out.get(name, LeftOut(0))

    def _worst(self) -> str:
        counts = [
            f"{corrupt} of {corrupt + drawn} of {name}"
            for name, corrupt, drawn in zip(self._names, self._corrupt, self._drawn, strict=True)
            if corrupt
        ]
        last = list(self._named.values())[-1]
        return f"{', '.join(counts)}; the last one is {last}"


def _sittings(file: Path) -> list[Any]:
    if not file.is_file():
        return []
    stored = read_json(file, what="report of a run's data")
    if not isinstance(stored, list):
        raise ValueError(
            f"{file} must hold a list, one entry a sitting; got {type(stored).__name__}. Remove it"
        )
    return stored
