"""Checkpoints of a run: Orbax, asynchronous and atomic, with the config and the commit beside them.

All hosts of a run write a checkpoint together, and read it together; what is written once, such as its
checksums, is written by the first of them.
"""

import contextlib
import logging
import shutil
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from poem_jax.io.checksums import check_checksums, write_checksums
from poem_jax.models.apply import init
from poem_jax.training.checkpoint_errors import (
    CheckpointDamaged,
    CheckpointNotWritten,
    names_damage,
    names_failed_write,
    names_unreadable,
)
from poem_jax.training.config import TrainConfig, flatten_config, git_commit
from poem_jax.training.hosts import (
    as_on_first_host,
    check_same_everywhere,
    check_shared_folder,
    is_first_host,
    wait_for_all,
)
from poem_jax.training.identity import CONFIG_FILE, check_same_config, write_identity
from poem_jax.training.keeping import NewestAndBest, Scores, what_is_scored
from poem_jax.training.state import TrainState, create_state, evaluation_params
from poem_jax.weights.store import check_leaves, flatten, save, unflatten

_FOLDER = "checkpoints"
_CHECKSUMS = "seals"
"""Folder of the checksums, one file a step; the name that the first runs have."""
_SET_ASIDE = "damaged"
_SCORES = "scores.json"

_log = logging.getLogger(__name__)


class Checkpoints:
    """The checkpoints of one run directory; use it as a context manager."""

    def __init__(self, run_dir: str | Path, config: TrainConfig, *, read_only: bool = False) -> None:
        """Open or make a run directory; `read_only` leaves it to the run that may write there."""
        self.run_dir = Path(run_dir).resolve()
        self._place = self.run_dir / _FOLDER
        self.config = config
        self._read_only = read_only
        check_same_config(self.run_dir, config, begun=self._place.is_dir())
        self._meta = {"config": flatten_config(config), "git_commit": git_commit()}
        wait_for_all("the config of the run is checked")
        if not read_only:
            self.run_dir.mkdir(parents=True, exist_ok=True)
            check_shared_folder(self.run_dir, "--train.out")
            if is_first_host():
                write_identity(self.run_dir, config, self._meta["git_commit"])
        elif not self._place.is_dir():
            raise FileNotFoundError(f"no checkpoints in {self.run_dir}: train first, or pass --train.out")
        self._scores = Scores(self.run_dir / _SCORES, None if read_only else what_is_scored(config))
        keep = NewestAndBest(config.train.keep_checkpoints, self._scores, best=config.train.keep_best)
        self._orbax = ocp.training.Checkpointer(
            str(self._place), preservation_policy=keep, cleanup_tmp_directories=not read_only
        )
        self._check_same_steps()
        self._written: int | None = None
        """The step that is being written, or is written and has no checksums yet."""

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # An error on the way leaves the checkpoint before it as good as it is.
        with contextlib.nullcontext() if kind is None else contextlib.suppress(Exception):
            self._finish_and_close()

    def _finish_and_close(self) -> None:
        try:
            self.finish()
        except CheckpointNotWritten:
            # Orbax raises its own error of a failed write once more when it is closed.
            with contextlib.suppress(Exception):
                self._orbax.close()
            raise
        self._orbax.close()

    def finish(self) -> None:
        """Wait for the write in the background, and write the checksums of what it wrote.

        Raises:
            CheckpointNotWritten: the disk is full, say.
        """
        if self._written is None:
            return
        step, self._written = self._written, None
        with names_failed_write(step, self._place):
            self._orbax.wait()
            if is_first_host():
                self._write_checksums(step)

    def confirm_write(self) -> None:
        """Where the write in the background has ended, write the checksums of its files; wait for nothing.

        Raises:
            CheckpointNotWritten: it ended badly.
        """
        if self._written is not None and not self._orbax.is_saving_in_progress():
            self.finish()

    def _write_checksums(self, step: int) -> None:
        """Write those of a step that this sitting saw written to its end; those of removed steps go."""
        write_checksums(self._checksums(step), self._folder(step))
        for file in (self.run_dir / _CHECKSUMS).glob("*.json"):
            if not (self._place / file.stem).is_dir():
                file.unlink()

    @property
    def config_file(self) -> Path:
        """The resolved config of the run."""
        return self.run_dir / CONFIG_FILE

    @property
    def latest_step(self) -> int | None:
        """Step of the newest checkpoint."""
        return max(self.steps, default=None)

    @property
    def steps(self) -> list[int]:
        """Steps of all checkpoints, the newest first."""
        return sorted((saved.step for saved in self._orbax.checkpoints), reverse=True)

    @property
    def best_step(self) -> int | None:
        """Step of the checkpoint with the least vertex error in validation; None where none has one."""
        return self._scores.best_of(self.steps)

    def save(self, state: TrainState, *, wait: bool = False, score: float | None = None) -> None:
        """Write the state in the background; an earlier write is finished first.

        The state is copied before this returns, since the next step may overwrite its donated buffers.

        Args:
            state: what is written.
            wait: until it is.
            score: its mean vertex error in validation, for `keep_best` and `best_step`; None = not known.

        Raises:
            CheckpointNotWritten: this one with `wait`, or else the one before it.
        """
        self.finish()
        step = int(state.step)
        if step == self.latest_step:
            return
        with names_failed_write(step, self._place):
            self._scores.note(step, score, write=is_first_host())
            if is_first_host():
                self._checksums(step).unlink(missing_ok=True)
            leaves = flatten(jax.tree.map(jnp.copy, state))
            self._orbax.save_async(step, leaves, force=True, custom_metadata=self._meta)
        self._written = step
        if wait:
            self.finish()

    def restore(self, like: TrainState) -> TrainState:
        """Read the newest sound checkpoint onto the devices and shardings of `like`, which may be others than
        those that wrote it.

        One that is damaged, or has no checksums since the run ended while it was written, is named in a
        warning and set aside, and the one before it is taken: a run that goes on from there computes the
        same. Only where none with checksums is left is the newest one taken unchecked, with a warning. A
        checkpoint that is whole and cannot be read all the same stays where it is.

        Raises:
            FileNotFoundError: there is no checkpoint.
            ValueError: none is whole, or the newest whole one cannot be read or does not fit `like`.
        """
        if not self.steps:
            raise FileNotFoundError(f"no checkpoint in {self._place}")
        problems: list[str] = []
        checked = as_on_first_host([step for step in self.steps if self._checksums(step).is_file()])
        unchecked = [step for step in self.steps if step not in checked]
        for step in checked + unchecked:
            try:
                state = self.read(step, like)
            except CheckpointDamaged as error:
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

    def read(self, step: int, like: TrainState) -> TrainState:
        """Read this checkpoint as `restore` does.

        Raises:
            CheckpointDamaged: its files are not those that were written.
            ValueError: they are, but cannot be read, or do not fit `like`.
        """
        template = flatten(like)
        checked = bool(as_on_first_host([self._checksums(step).is_file()])[0])
        with names_damage(step, self._place):
            # One host is enough: the files are the same for all.
            if is_first_host():
                check_checksums(self._checksums(step), self._folder(step))
        with names_unreadable(step, self._place, checked=checked):
            leaves = self._orbax.load(step, template)
            check_leaves(leaves, template, f"checkpoint {step}")
        return unflatten(leaves, like)

    def _without_checksums(self, step: int) -> str:
        return f"checkpoint {step} in {self._place} has no checksums: the run ended while it was written"

    def _set_aside(self, steps: list[int]) -> None:
        """Move checkpoints to where nothing takes them for good ones, unless the run is only read."""
        if self._read_only or not steps:
            return
        wait_for_all("checkpoints are set aside")
        for step in steps if is_first_host() else []:
            folder = self.run_dir / _SET_ASIDE / str(step)
            shutil.rmtree(folder, ignore_errors=True)
            folder.parent.mkdir(exist_ok=True)
            self._folder(step).rename(folder)
            self._checksums(step).unlink(missing_ok=True)
            _log.warning("it is now %s; training goes on from the checkpoint before it", folder)
        wait_for_all("checkpoints have been set aside")
        self._orbax.reload()
        self._check_same_steps()

    def _check_same_steps(self) -> None:
        """Insist that all hosts see the same checkpoints; else some would wait for the others for ever."""
        steps = ", ".join(map(str, self.steps)) or "none"
        check_same_everywhere(f"checkpoints in {self._place} (this one sees {steps})", steps)

    def _folder(self, step: int) -> Path:
        return self._place / str(step)

    def _checksums(self, step: int) -> Path:
        return self.run_dir / _CHECKSUMS / f"{step}.json"


def export_run(config: TrainConfig, path: str | Path, *, dtype: Any = np.float16) -> int:
    """Write the averaged weights of a run's newest checkpoint, with `keep_best` of its best one, as a model
    that `poem_jax.load` reads; return its step.

    Args:
        config: the experiment; `train.out` names the run.
        path: folder to write; replaced if it exists.
        dtype: storage type of weights and statistics; None = float32.

    Raises:
        FileNotFoundError: the run has no checkpoint.
        ValueError: the best one is damaged, or none can be read.
    """
    fresh = create_state(init(config.model, key=jax.random.key(0)), config)
    with Checkpoints(config.train.out, config, read_only=True) as checkpoints:
        best = checkpoints.best_step if config.train.keep_best else None
        try:
            state = checkpoints.restore(fresh) if best is None else checkpoints.read(best, fresh)
        except CheckpointDamaged as error:
            raise ValueError(
                f"the best {error}. --train.no-keep-best exports the newest one that is whole"
            ) from error
    save(path, config.model, evaluation_params(state), dtype=dtype, overwrite=True)
    return int(state.step)
