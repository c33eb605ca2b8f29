"""What a run says: log lines, a JSONL file of metrics, a progress bar, and TensorBoard if asked for."""

import json
import logging
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from tqdm import tqdm

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import parse_json
from poem_jax.training.config import TrainConfig

log = logging.getLogger(__name__)


class Journal:
    """Writes metrics of a run to every place that the config names; use it as a context manager."""

    def __init__(self, run_dir: Path, config: TrainConfig, first_step: int) -> None:
        run_dir.mkdir(parents=True, exist_ok=True)
        file = run_dir / "metrics.jsonl"
        forget_after(file, first_step)
        self._file = file.open("a", encoding="utf-8")
        self._bar = tqdm(
            total=config.train.steps, initial=first_step, unit="step", disable=not config.train.progress
        )
        self._board = _tensorboard(run_dir) if config.train.tensorboard else None
        self._start = time.monotonic()

    def __enter__(self) -> "Journal":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        self._bar.close()
        if self._board is not None:
            self._board.close()

    def advance(self, steps: int = 1) -> None:
        """Move the progress bar."""
        self._bar.update(steps)

    def write(self, step: int, metrics: dict[str, float], *, group: str = "train") -> None:
        """Record the metrics of one step."""
        seconds = round(time.monotonic() - self._start, 2)
        line = {"step": step, "group": group, "seconds": seconds, **metrics}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()
        shown = {
            name: f"{metrics[name]:.4g}" for name in ("loss", "mpvpe_mm", "keypoint_px") if name in metrics
        }
        self._bar.set_postfix(shown, refresh=False)
        if self._board is not None:
            for name, value in metrics.items():
                self._board.add_scalar(f"{group}/{name}", value, step)

    def image(self, step: int, name: str, picture: Any) -> None:
        """Send an image (h, w, 3), uint8, to TensorBoard."""
        if self._board is not None:
            self._board.add_image(name, picture, step, dataformats="HWC")


def forget_after(file: Path, step: int) -> None:
    """Drop the lines of a metrics file that a run going on from `step` will write again, and broken ones.

    A run that was killed has written beyond its newest checkpoint, and maybe half a line.
    """
    if not file.exists():
        return
    text = file.read_text(encoding="utf-8", errors="replace")
    kept = "".join(line for line in text.splitlines(keepends=True) if _is_until(line, step))
    if kept != text:
        with whole_file(file) as temporary:
            temporary.write_text(kept, encoding="utf-8")


def _is_until(line: str, step: int) -> bool:
    try:
        return line.endswith("\n") and parse_json(line, "a line", allow_nan=True)["step"] <= step
    except (ValueError, TypeError, KeyError):
        return False


def _tensorboard(run_dir: Path) -> Any:
    from tensorboardX import SummaryWriter  # pyright: ignore[reportMissingImports]

    return SummaryWriter(str(run_dir / "tensorboard"))
