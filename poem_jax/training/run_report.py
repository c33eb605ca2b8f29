"""What a run has come to: `report.json` and `report.html`, written at every end of a sitting."""

import json
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax

from poem_jax.io.atomic import whole_file
from poem_jax.io.stopping import Stopped
from poem_jax.training.checkpoints import Checkpoints
from poem_jax.training.config import TrainConfig, git_commit
from poem_jax.training.hosts import is_first_host
from poem_jax.training.journal import METRICS, PANELS, read_entries
from poem_jax.training.run_page import Entry, page

REPORT, PAGE = "report.json", "report.html"

log = logging.getLogger(__name__)


@dataclass
class Sitting:
    """One sitting of a run, as far as it has come."""

    config: TrainConfig
    command: str | None = None
    """The command line that goes on with the run; None = whoever called knows."""
    first_step: int | None = None
    """None = it has not begun: what stood in the run's folder stays as it is."""
    step: int = 0
    """Finished steps of the run."""
    checkpoints: Checkpoints | None = None
    left_out: list[int] = field(default_factory=list)
    """Steps, counted from 0, that were not finite and left out."""
    stopped_early: str = "the time of `train.max_minutes` was over"
    """What the report says where the run stops before its last step, neither by a signal nor by an error."""
    start: float = field(default_factory=time.monotonic)

    def begin(self, first_step: int, checkpoints: Checkpoints) -> None:
        """Note where training begins; from now on there is something to report."""
        self.first_step = self.step = first_step
        self.checkpoints = checkpoints

    @property
    def how_to_go_on(self) -> str:
        """Say what continues the run."""
        return self.command or "the same command again"


@contextmanager
def reported(sitting: Sitting) -> Iterator[None]:
    """Write the report when the block ends, however it ends; the first host does."""
    try:
        yield
    except BaseException as error:
        stopped = isinstance(error, KeyboardInterrupt)
        name = error.signal.name if isinstance(error, Stopped) else "SIGINT"
        end = f"stopped by {name}" if stopped else f"failed: {type(error).__name__}: {error}"
        try:
            _write(sitting, end)
        except Exception as problem:
            # What ended the run matters more, whatever is wrong with the report.
            log.warning("the report of the run cannot be written: %r", problem)
        raise
    finished = sitting.step >= sitting.config.train.steps
    _write(sitting, "finished" if finished else sitting.stopped_early)


def _write(sitting: Sitting, end: str) -> None:
    if sitting.first_step is None or not is_first_host():
        return
    run_dir = Path(sitting.config.train.out)
    entries = read_entries(run_dir / METRICS)
    report = summary(sitting, end, entries)
    panels = sorted((run_dir / PANELS).glob("*.png"))
    with whole_file(run_dir / REPORT) as file:
        text = json.dumps(_in_json(report), indent=1, allow_nan=False)
        file.write_text(text + "\n", encoding="utf-8")
    with whole_file(run_dir / PAGE) as file:
        text = page(sitting.config.name, _facts(report), entries, panels[-1] if panels else None)
        file.write_text(text, encoding="utf-8")
    log.info("report in %s", run_dir / PAGE)


def summary(sitting: Sitting, end: str, entries: Sequence[Entry]) -> dict[str, Any]:
    """Return what `report.json` holds.

    Args:
        sitting: the one that ends.
        end: how it ends.
        entries: metrics of the whole run.
    """
    assert sitting.first_step is not None
    assert sitting.checkpoints is not None
    train = [entry for entry in entries if entry.get("group") == "train"]
    validation = [entry for entry in entries if entry.get("group") == "validation"]
    return {
        "name": sitting.config.name,
        "end": end,
        "step": sitting.step,
        "steps": sitting.config.train.steps,
        "to_go_on": None if end == "finished" else sitting.how_to_go_on,
        "git_commit": git_commit(),
        "devices": [str(device) for device in jax.devices()],
        "hosts": jax.process_count(),
        "sitting": {
            "first_step": sitting.first_step,
            "seconds": round(time.monotonic() - sitting.start, 1),
            "steps_left_out": sitting.left_out,
        },
        "checkpoints": {
            "newest": sitting.checkpoints.latest_step,
            "best": sitting.checkpoints.best_step,
        },
        "train": train[-1] if train else None,
        "validation": validation[-1] if validation else None,
        "best": _best(validation),
    }


def _best(validation: Sequence[Entry]) -> dict[str, dict[str, float]]:
    """Return the least mean vertex error of every group of held-out samples, and its step."""
    best: dict[str, dict[str, float]] = {}
    for entry in validation:
        for name, value in entry.items():
            is_error = name.startswith("mpvpe_mm") and math.isfinite(value)
            if is_error and (name not in best or value < best[name]["value"]):
                best[name] = {"value": value, "step": entry["step"]}
    return best


def _in_json(value: Any) -> Any:
    """Replace numbers that are not finite by None: JSON has none of them."""
    if isinstance(value, Mapping):
        return {name: _in_json(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_in_json(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _facts(report: Mapping[str, Any]) -> dict[str, str]:
    """Put the report into words, for the table of the page."""
    sitting, saved = report["sitting"], report["checkpoints"]
    facts = {
        "end": report["end"],
        "step": f"{report['step']} of {report['steps']}",
        "to go on": report["to_go_on"] or "",
        "checkpoint": "" if saved["newest"] is None else f"step {saved['newest']}",
        "best checkpoint": "" if saved["best"] is None else f"step {saved['best']}",
        "this sitting": f"from step {sitting['first_step']}, {sitting['seconds']} s",
        "steps left out": ", ".join(map(str, sitting["steps_left_out"])),
        "devices": ", ".join(report["devices"]),
        "hosts": str(report["hosts"]),
        "commit": report["git_commit"],
    }
    newest = report["train"] or {}
    shown = {"loss": "{:.4g}", "samples_per_second": "{:.1f}", "data_wait_share": "{:.1%}"}
    facts |= {
        name.replace("_", " "): form.format(newest[name]) for name, form in shown.items() if name in newest
    }
    facts |= {
        f"best {name}": f"{found['value']:.2f} at step {found['step']}"
        for name, found in report["best"].items()
    }
    return {name: text for name, text in facts.items() if text}
