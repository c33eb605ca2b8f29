"""Checkpoints of a run: Orbax, asynchronous and atomic, with the config and the commit beside them."""

import contextlib
import json
import logging
import shutil
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from poem_jax.io.atomic import whole_file
from poem_jax.io.checksums import check_checksums, write_checksums
from poem_jax.io.json_file import read_json
from poem_jax.models.apply import init
from poem_jax.training.config import TrainConfig, config_json, differences, flatten_config, git_commit
from poem_jax.training.state import TrainState, create_state, evaluation_params
from poem_jax.weights.store import check_leaves, flatten, save, unflatten

_FOLDER = "checkpoints"
_CHECKSUMS = "seals"
"""Folder of the checksums, one file a step; the name that the first runs have."""
_SET_ASIDE = "damaged"
_CONFIG = "train_config.json"
_COMMIT = "git_commit.txt"

_log = logging.getLogger(__name__)


class Checkpoints:
    """The checkpoints of one run directory; use it as a context manager."""

    def __init__(self, run_dir: str | Path, config: TrainConfig, *, read_only: bool = False) -> None:
        """Open or make a run directory; `read_only` leaves it to the run that may be writing there."""
        self.run_dir = Path(run_dir).resolve()
        self.config = config
        self._read_only = read_only
        check_same_config(self.run_dir, config)
        self._meta = {"config": flatten_config(config), "git_commit": git_commit()}
        if not read_only:
            self.run_dir.mkdir(parents=True, exist_ok=True)
            self._write_identity()
        elif not (self.run_dir / _FOLDER).is_dir():
            raise FileNotFoundError(f"no checkpoints in {self.run_dir}: train first, or pass --train.out")
        keep = ocp.training.preservation_policies.LatestN(n=config.train.keep_checkpoints)
        self._orbax = ocp.training.Checkpointer(
            str(self.run_dir / _FOLDER),
            preservation_policy=keep,  # pyright: ignore[reportArgumentType] - Orbax's own two spellings
            cleanup_tmp_directories=not read_only,
        )
        self._written: int | None = None
        """The step that is being written, or is written and has no checksums yet."""

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if not self._read_only:
                # An error on the way leaves the checkpoint before it as good as it is.
                with contextlib.nullcontext() if kind is None else contextlib.suppress(Exception):
                    self.finish()
        finally:
            self._orbax.close()

    def finish(self) -> None:
        """Wait for the write in the background, and write the checksums of what it wrote."""
        self._orbax.wait()
        self.confirm_write()

    def confirm_write(self) -> None:
        """Where the write in the background has ended, write the checksums of its files.

        Only of what this sitting wrote: a checkpoint without checksums is one whose writing nobody saw to its
        end. Checksums of removed steps go.
        """
        if self._written is None or self._orbax.is_saving_in_progress():
            return
        write_checksums(self._checksums(self._written), self._folder(self._written))
        self._written = None
        for file in (self.run_dir / _CHECKSUMS).glob("*.json"):
            if not (self.run_dir / _FOLDER / file.stem).is_dir():
                file.unlink()

    @property
    def config_file(self) -> Path:
        """The resolved config of the run."""
        return self.run_dir / _CONFIG

    @property
    def latest_step(self) -> int | None:
        """Step of the newest checkpoint."""
        return max(self.steps, default=None)

    @property
    def steps(self) -> list[int]:
        """Steps of all checkpoints, the newest first."""
        return sorted((saved.step for saved in self._orbax.checkpoints), reverse=True)

    def save(self, state: TrainState, *, wait: bool = False) -> None:
        """Write the state in the background; an earlier write is finished first.

        The state is copied before this returns, since the next step may overwrite its donated buffers.
        """
        self.finish()
        step = int(state.step)
        if step == self.latest_step:
            return
        self._checksums(step).unlink(missing_ok=True)
        leaves = flatten(jax.tree.map(jnp.copy, state))
        self._orbax.save_async(step, leaves, force=True, custom_metadata=self._meta)
        self._written = step
        if wait:
            self.finish()

    def restore(self, like: TrainState) -> TrainState:
        """Read the newest sound checkpoint onto the devices and shardings of `like`.

        One that is damaged, or has no checksums since the run ended while it was written, is named in a
        warning and set aside, and the one before it is taken: a run that goes on from there computes the
        same. Only where none with checksums is left is the newest one taken unchecked, with a warning.

        Raises:
            FileNotFoundError: there is no checkpoint.
            ValueError: none can be read, or their arrays do not fit `like`.
        """
        if not self.steps:
            raise FileNotFoundError(f"no checkpoint in {self.run_dir / _FOLDER}")
        problems: list[str] = []
        checked = [step for step in self.steps if self._checksums(step).is_file()]
        unchecked = [step for step in self.steps if step not in checked]
        for step in checked + unchecked:
            try:
                state = self._read(step, like)
            except ValueError as error:
                problems.append(str(error))
                continue
            newer = [other for other in self.steps if other > step]
            problems += [self._without_checksums(other) for other in newer if other in unchecked]
            if step in unchecked:
                problems.append(f"{self._without_checksums(step)}; it is taken unchecked, since none has any")
            for problem in problems:
                _log.warning("%s", problem)
            self._set_aside(newer)
            return state
        raise ValueError(
            f"{'; '.join(problems)}. Remove that step's folder to begin anew, or choose another --train.out"
        )

    def _read(self, step: int, like: TrainState) -> TrainState:
        template = flatten(like)
        try:
            check_checksums(self._checksums(step), self._folder(step))
            leaves = self._orbax.load(step, template)
            check_leaves(leaves, template, f"checkpoint {step}")
        except Exception as error:
            # Orbax and TensorStore raise many kinds; each means that the arrays cannot be read.
            raise ValueError(
                f"checkpoint {step} in {self.run_dir / _FOLDER} is damaged or belongs to another model "
                f"({type(error).__name__}: {str(error)[:300]})"
            ) from error
        return unflatten(leaves, like)

    def _without_checksums(self, step: int) -> str:
        place = self.run_dir / _FOLDER
        return f"checkpoint {step} in {place} has no checksums: the run ended while it was written"

    def _set_aside(self, steps: list[int]) -> None:
        """Move checkpoints to where nothing takes them for good ones, unless the run is only read."""
        if self._read_only or not steps:
            return
        for step in steps:
            folder = self.run_dir / _SET_ASIDE / str(step)
            shutil.rmtree(folder, ignore_errors=True)
            folder.parent.mkdir(exist_ok=True)
            self._folder(step).rename(folder)
            self._checksums(step).unlink(missing_ok=True)
            _log.warning("it is now %s; training goes on from the checkpoint before it", folder)
        self._orbax.reload()

    def _folder(self, step: int) -> Path:
        return self.run_dir / _FOLDER / str(step)

    def _checksums(self, step: int) -> Path:
        return self.run_dir / _CHECKSUMS / f"{step}.json"

    def _write_identity(self) -> None:
        with whole_file(self.config_file) as file:
            file.write_text(config_json(self.config) + "\n", encoding="utf-8")
        with whole_file(self.run_dir / _COMMIT) as file:
            file.write_text(self._meta["git_commit"] + "\n", encoding="utf-8")


def check_same_config(run_dir: Path, config: TrainConfig) -> None:
    """Refuse to go on in a run directory that another experiment made.

    Raises:
        ValueError: the config stored there differs; names the fields and the flag that allows it.
    """
    file = run_dir / _CONFIG
    if not file.is_file() or not (run_dir / _FOLDER).is_dir():
        return
    stored = read_json(file, what="config of a run")
    if not isinstance(stored, dict):
        raise ValueError(f"{file} must hold the config of a run; got a {type(stored).__name__}. Remove it")
    changed = differences(stored, _as_stored(config))
    if changed and not config.train.allow_config_change:
        raise ValueError(
            f"{run_dir} holds a run of another config: {'; '.join(changed[:10])}. "
            "Choose another --train.out, or pass --train.allow-config-change to go on with the new one"
        )


def export_run(config: TrainConfig, path: str | Path, *, dtype: Any = np.float16) -> int:
    """Write the averaged weights of a run's newest checkpoint as a model that `poem_jax.load` reads.

    Args:
        config: the experiment; `train.out` names the run.
        path: folder to write; replaced if it exists.
        dtype: storage type of weights and statistics; None = float32.

    Returns:
        The step whose weights were written.
    """
    fresh = create_state(init(config.model, key=jax.random.key(0)), config)
    with Checkpoints(config.train.out, config, read_only=True) as checkpoints:
        state = checkpoints.restore(fresh)
    save(path, config.model, evaluation_params(state), dtype=dtype, overwrite=True)
    return int(state.step)


def _as_stored(config: TrainConfig) -> dict[str, Any]:
    """Pass through JSON, so that tuples and numbers compare as they were written."""
    return json.loads(config_json(config))
