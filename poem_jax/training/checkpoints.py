"""Checkpoints of a run: Orbax, asynchronous and atomic, with the config and the commit beside them."""

import json
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

from poem_jax.io.atomic import whole_file
from poem_jax.io.checksums import check_checksums, write_checksums
from poem_jax.models.poem import init
from poem_jax.training.config import TrainConfig, config_json, differences, flatten_config, git_commit
from poem_jax.training.state import TrainState, create_state, evaluation_params
from poem_jax.weights.store import check_leaves, flatten, save, unflatten

_FOLDER = "checkpoints"
_SEALS = "seals"
_CONFIG = "train_config.json"
_COMMIT = "git_commit.txt"


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

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None and not self._read_only:
                self.finish()
        finally:
            self._orbax.close()

    def finish(self) -> None:
        """Wait for the write in the background, and seal what is new; seals of removed steps go."""
        self._orbax.wait()
        steps = {saved.step for saved in self._orbax.checkpoints}
        for seal in (self.run_dir / _SEALS).glob("*.json"):
            if seal.stem not in map(str, steps):
                seal.unlink()
        for step in steps:
            if not self._seal(step).is_file():
                write_checksums(self._seal(step), self.run_dir / _FOLDER / str(step))

    @property
    def latest_step(self) -> int | None:
        """Step of the newest whole checkpoint."""
        latest = self._orbax.latest
        return None if latest is None else latest.step

    def save(self, state: TrainState, *, wait: bool = False) -> None:
        """Write the state in the background; an earlier write is finished first.

        The state is copied before this returns, since the next step may overwrite its donated buffers.
        """
        self.finish()
        step = int(state.step)
        if step == self.latest_step:
            return
        self._seal(step).unlink(missing_ok=True)
        leaves = flatten(jax.tree.map(jnp.copy, state))
        self._orbax.save_async(step, leaves, force=True, custom_metadata=self._meta)
        if wait:
            self.finish()

    def restore(self, like: TrainState, step: int | None = None) -> TrainState:
        """Read a checkpoint (the newest by default) onto the devices and shardings of `like`.

        Raises:
            FileNotFoundError: there is no checkpoint.
            ValueError: it is damaged, or its arrays do not fit `like`.
        """
        step = self.latest_step if step is None else step
        if step is None:
            raise FileNotFoundError(f"no checkpoint in {self.run_dir / _FOLDER}")
        template = flatten(like)
        try:
            check_checksums(self._seal(step), self.run_dir / _FOLDER / str(step))
            leaves = self._orbax.load(step, template)
        except Exception as error:
            # Orbax and TensorStore raise many kinds; each means that the arrays cannot be read.
            raise ValueError(
                f"checkpoint {step} in {self.run_dir / _FOLDER} is damaged or belongs to another model "
                f"({type(error).__name__}: {str(error)[:300]}). Remove that step's folder to go on from an "
                "older one, or choose another --train.out"
            ) from error
        check_leaves(leaves, template, f"checkpoint {step} in {self.run_dir}")
        return unflatten(leaves, like)

    def _seal(self, step: int) -> Path:
        return self.run_dir / _SEALS / f"{step}.json"

    def _write_identity(self) -> None:
        with whole_file(self.run_dir / _CONFIG) as file:
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
    stored = json.loads(file.read_text(encoding="utf-8"))
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
