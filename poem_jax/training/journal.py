"""What a run says: a JSONL file of metrics, a progress bar, pictures, and TensorBoard if asked for.

Where there are several hosts, the first one says it for all.
"""

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from tqdm import tqdm

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import parse_json
from poem_jax.training.config import TrainConfig
from poem_jax.training.hosts import is_first_host
from poem_jax.training.pictures import write_png
from poem_jax.typing import Array, UInt8

METRICS, PANELS = "metrics.jsonl", "panels"
_SHOWN = {
    "loss": "loss",
    "mpvpe_mm": "mpvpe_mm",
    "keypoint_px": "keypoint_px",
    "samples_per_second": "samples/s",
}
"""Beside the progress bar: the metric, and what it is called there."""
_LOG_FILE_S = 30.0
"""Seconds between two states of the bar where nobody watches it move."""


class Journal:
    """Writes metrics of a run to every place that the config names; use it as a context manager."""

    def __init__(self, run_dir: Path, config: TrainConfig, first_step: int) -> None:
        self._run_dir, self._first_host = run_dir, is_first_host()
        self._start = time.monotonic()
        if not self._first_host:
            return
        run_dir.mkdir(parents=True, exist_ok=True)
        file = run_dir / METRICS
        forget_after(file, first_step)
        self._file = file.open("a", encoding="utf-8")
        self._bar = tqdm(
            total=config.train.steps,
            initial=first_step,
            unit="step",
            disable=not config.train.progress,
            mininterval=0.1 if sys.stderr.isatty() else _LOG_FILE_S,
        )
        self._board = _tensorboard(run_dir, first_step) if config.train.tensorboard else None

    def __enter__(self) -> "Journal":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._first_host:
            return
        self._file.close()
        self._bar.close()
        if self._board is not None:
            self._board.close()

    def advance(self, steps: int = 1) -> None:
        """Move the progress bar."""
        if self._first_host:
            self._bar.update(steps)

    def write(self, step: int, metrics: Mapping[str, float], *, group: str = "train") -> None:
        """Record the metrics of one step."""
        if not self._first_host:
            return
        seconds = round(time.monotonic() - self._start, 2)
        line = {"step": step, "group": group, "seconds": seconds, **metrics}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        shown = {word: f"{metrics[name]:.4g}" for name, word in _SHOWN.items() if name in metrics}
        if shown:
            self._bar.set_postfix(shown, refresh=False)
        if self._board is not None:
            for name, value in metrics.items():
                self._board.add_scalar(f"{group}/{name}", value, step)

    def image(self, step: int, name: str, file: Path, picture: UInt8[Array, "h w 3"]) -> None:
        """Write a picture as PNG, a path below the run's folder, and send it to TensorBoard."""
        if not self._first_host:
            return
        write_png(self._run_dir / file, picture)
        if self._board is not None:
            self._board.add_image(name, picture, step, dataformats="HWC")


def read_entries(file: Path) -> list[dict[str, Any]]:
    """Return the lines of a metrics file, broken ones left out; none where there is no file."""
    if not file.exists():
        return []
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
    return [entry for line in lines if (entry := _entry(line)) is not None]


def forget_after(file: Path, step: int) -> None:
    """Drop the lines of a metrics file that a run going on from `step` will write again, and broken ones.

    A run that was killed has written beyond its newest checkpoint, and maybe half a line. One that begins at
    step 0 writes all again, what it measured before its first step too.
    """
    if not file.exists():
        return
    text = file.read_text(encoding="utf-8", errors="replace")
    lines = text.splitlines(keepends=True)
    last = step if step > 0 else -1
    kept = "".join(line for line in lines if (entry := _entry(line)) is not None and entry["step"] <= last)
    if kept != text:
        with whole_file(file) as temporary:
            temporary.write_text(kept, encoding="utf-8")


def _entry(line: str) -> dict[str, Any] | None:
    """Read a line; None = it is not a whole line of metrics."""
    try:
        entry = parse_json(line, "a line", allow_nan=True) if line.endswith("\n") else None
    except ValueError:
        return None
    is_metrics = isinstance(entry, dict) and isinstance(entry.get("step"), int)
    return entry if is_metrics else None


def _tensorboard(run_dir: Path, first_step: int) -> Any:
    """Open the writer; what was sent of the steps that a run takes again is hidden."""
    from tensorboardX import SummaryWriter  # pyright: ignore[reportMissingImports]

    folder = run_dir / "tensorboard"
    again = {"purge_step": first_step + 1 if first_step else 0} if folder.exists() else {}
    return SummaryWriter(str(folder), **again)
