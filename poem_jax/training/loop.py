"""The training loop: everything with an effect. The mathematics is in `step.py`."""

import logging
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import jax
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.loader import draw_ahead
from poem_jax.io.atomic import whole_file
from poem_jax.io.stopping import Stopped
from poem_jax.models.apply import init
from poem_jax.training.checkpoints import Checkpoints
from poem_jax.training.config import TrainConfig, git_commit
from poem_jax.training.journal import Journal
from poem_jax.training.parallel import Step, check_batch_sizes, compile_step, data_mesh, put_batch, replicated
from poem_jax.training.preflight import check_before_training
from poem_jax.training.source import BatchAt, drawing_threads, open_training_data, training_batches
from poem_jax.training.state import TrainState, create_state, restart_moments
from poem_jax.training.step import Metrics
from poem_jax.training.validation import Validation
from poem_jax.typing import Params
from poem_jax.weights.store import SHIPPED, flatten, load

log = logging.getLogger(__name__)


def train(config: TrainConfig, *, batch_at: BatchAt | None = None) -> TrainState:
    """Train, or go on from the newest checkpoint of `config.train.out`.

    Stops at `train.steps`, after `train.max_minutes`, or on SIGTERM or SIGINT; always with a checkpoint.

    Args:
        config: the experiment.
        batch_at: source of the batches by step; None = what `config.data` says.

    Returns:
        The last state.

    Raises:
        FileNotFoundError: a data set of the config, or a file of it, is missing.
        FloatingPointError: a metric stopped being finite; names it and the step; no checkpoint is written.
        ModuleNotFoundError: an extra that the run needs is not installed.
        Stopped: SIGTERM or SIGINT came; the step under way and its checkpoint are finished.
        TooManyCorruptSamples: more of the data cannot be used than `data.mixture` allows.
        ValueError: the run directory belongs to another config or was begun with other data files, it cannot
            be written to, no checkpoint in it can be read, or a batch cannot be split over the devices.
        WorkerDied: a data worker ended before its work did.
    """
    check_before_training(config)
    mesh = data_mesh()
    check_batch_sizes(config, mesh)
    run_dir = Path(config.train.out)
    mixture = open_training_data(config) if batch_at is None else None
    with (
        Checkpoints(run_dir, config) as checkpoints,
        nullcontext(batch_at)
        if batch_at is not None
        else training_batches(config, mixture, begun=checkpoints.latest_step is not None) as draw,
    ):
        state = initial_state(config, checkpoints, mesh)
        first_step = int(state.step)
        batches = draw_ahead(
            draw, first_step, ahead=config.data.prefetch, workers=drawing_threads(config.data)
        )
        with Journal(run_dir, config, first_step) as journal, stop_after_the_step() as stopped:
            run = _Run(config, mesh, checkpoints, journal, stopped)
            try:
                return run.go(state, batches)
            finally:
                batches.close()


def initial_state(config: TrainConfig, checkpoints: Checkpoints, mesh: jax.sharding.Mesh) -> TrainState:
    """Return the state of the newest checkpoint, or a fresh one, on every device of the mesh."""
    state = create_state(_first_params(config), config)
    count = sum(leaf.size for leaf in jax.tree.leaves(state.params["trainable"]))
    state = jax.device_put(state, replicated(mesh))
    log.info("devices %s", [str(device) for device in mesh.devices.flat])
    log.info("%d trainable parameters", count)
    log.info("git commit %s", git_commit())
    log.info("config in %s", checkpoints.config_file)
    if checkpoints.latest_step is not None:
        state = checkpoints.restore(state)
        log.info("resumed at step %d from %s", int(state.step), checkpoints.run_dir)
    return state


def _first_params(config: TrainConfig) -> Params:
    if config.train.init_from is not None:
        folder = SHIPPED if config.train.init_from == "shipped" else config.train.init_from
        return load(folder, expected=config.model)[1]
    return init(config.model, key=jax.random.key(config.train.seed))


@contextmanager
def stop_after_the_step() -> Iterator[threading.Event]:
    """Turn SIGTERM and SIGINT into an event, so that the step under way and its checkpoint are finished.

    Then `Stopped` is raised; at a second signal at once.
    """
    event = threading.Event()
    received: list[signal.Signals] = []

    def note(number: int, frame: FrameType | None) -> None:
        if received:
            raise Stopped(signal.Signals(number))
        received.append(signal.Signals(number))
        event.set()
        # Not by `logging`: the signal may have come while a line was being written.
        os.write(2, b"stopping after this step, with a checkpoint; once more: at once\n")

    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    previous = {kind: signal.signal(kind, note) for kind in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield event
    finally:
        for kind, handler in previous.items():
            signal.signal(kind, handler)
    if received:
        raise Stopped(received[0])


class _Run:
    """One sitting of a run."""

    def __init__(
        self,
        config: TrainConfig,
        mesh: jax.sharding.Mesh,
        checkpoints: Checkpoints,
        journal: Journal,
        stopped: threading.Event,
    ) -> None:
        self.config, self.mesh, self.checkpoints, self.journal = config, mesh, checkpoints, journal
        self.stopped = stopped
        self.first_stage_step: Step = compile_step(config, mesh, first_stage=True)
        self.whole_step: Step = compile_step(config, mesh)
        self.validation = Validation(config, mesh) if config.train.validate_every else None
        self.unread: list[tuple[int, Metrics]] = []
        self.described = False
        self.compiled: set[tuple[bool, tuple[int, ...]]] = set()
        self.start = self.last_read = time.monotonic()

    def go(self, state: TrainState, batches: Iterator[MultiViewBatch]) -> TrainState:
        """Step until the end, the time limit or a signal; return the last state."""
        options = self.config.train
        key = jax.device_put(jax.random.key(options.seed + 1), replicated(self.mesh))
        step = int(state.step)
        while step < options.steps and not self._should_stop():
            if step == self.config.first_stage_steps > 0:
                self._read_metrics()
                state = restart_moments(state)
            batch = next(batches)
            self._describe(step, batch)
            state = self._step(step, state, put_batch(batch, self.mesh), key)
            step += 1
            if step % options.log_every == 0:
                self._read_metrics()
            if step % options.checkpoint_every == 0:
                self._checkpoint(state)
            if (
                self.validation
                and step % options.validate_every == 0
                and step > self.config.first_stage_steps
            ):
                self._validate(step, state)
        self._checkpoint(state, wait=True)
        log.info("stopped after step %d of %d", step, options.steps)
        return state

    def _step(self, step: int, state: TrainState, batch: MultiViewBatch, key: jax.Array) -> TrainState:
        first_stage = step < self.config.first_stage_steps
        step_function = self.first_stage_step if first_stage else self.whole_step
        self._announce(first_stage, batch.views.shape)
        with jax.transfer_guard("disallow"):
            state, metrics = step_function(state, batch, key)
        self.unread.append((step, metrics))
        if len(self.unread) > 1:
            # The host stays one step ahead of the devices, not more.
            jax.block_until_ready(self.unread[-2][1]["loss"])
        self.checkpoints.confirm_write()
        self.journal.advance()
        return state

    def _announce(self, first_stage: bool, shape: tuple[int, ...]) -> None:
        """Say that a program is compiled, when it is: a minute without news seems a long one."""
        if (first_stage, shape) in self.compiled:
            return
        self.compiled.add((first_stage, shape))
        part = "first-stage step" if first_stage else "step"
        log.info("compiling the %s for %d samples of %d views, once", part, *shape[:2])

    def _read_metrics(self) -> None:
        """Fetch the metrics since the last time, insist that they are finite, and record their means."""
        if not self.unread:
            return
        fetched = jax.device_get(self.unread)
        self.unread = []
        check_finite(fetched)
        now = time.monotonic()
        means = {name: float(np.mean([metrics[name] for _, metrics in fetched])) for name in fetched[0][1]}
        means["steps_per_second"] = len(fetched) / max(now - self.last_read, 1e-9)
        self.last_read = now
        self.journal.write(fetched[-1][0] + 1, means)

    def _validate(self, step: int, state: TrainState) -> None:
        assert self.validation is not None
        self._read_metrics()
        self.journal.write(step, self.validation(state), group="validation")
        self.last_read = time.monotonic()

    def _checkpoint(self, state: TrainState, *, wait: bool = False) -> None:
        self._read_metrics()
        self.checkpoints.save(state, wait=wait)

    def _describe(self, step: int, batch: MultiViewBatch) -> None:
        """Log what goes in, once a sitting; at step 0 keep a picture of it."""
        if self.described:
            return
        self.described = True
        log.info("batch %s", {name: np.shape(leaf) for name, leaf in flatten(batch).items()})
        if step == 0:
            picture = image_grid(batch.views)
            self.journal.image(step, "input", picture)
            with whole_file(self.checkpoints.run_dir / "input_step0.png") as file:
                cv2.imwrite(str(file), np.ascontiguousarray(picture[..., ::-1]))

    def _should_stop(self) -> bool:
        limit = self.config.train.max_minutes
        return self.stopped.is_set() or (limit is not None and time.monotonic() - self.start > 60 * limit)


def check_finite(metrics: list[tuple[int, dict[str, Any]]]) -> None:
    """Insist that every metric of every step is finite.

    Raises:
        FloatingPointError: names the first step (counted from 0) and its metrics.
    """
    for step, values in metrics:
        bad = {name: float(value) for name, value in values.items() if not math.isfinite(value)}
        if bad:
            raise FloatingPointError(
                f"training stopped: {bad} at step {step} (steps {metrics[0][0]} to {metrics[-1][0]} were "
                "checked). The newest checkpoint is from before; lower the learning rate, or look at this "
                f"step's batch: it is the source's batch {step}"
            )


def image_grid(views: np.ndarray, rows: int = 4) -> np.ndarray:
    """Lay out the first samples as rows and their views as columns: (h, w, 3) uint8, RGB."""
    pixels = np.asarray(views)[:rows]
    if pixels.dtype != np.uint8:
        pixels = np.clip(255.0 * pixels, 0, 255).astype(np.uint8)
    return np.concatenate([np.concatenate(list(sample), axis=1) for sample in pixels], axis=0)
