"""The training loop: everything with an effect. The mathematics is in `step.py`."""

import logging
import threading
import time
from collections.abc import Generator
from contextlib import closing, nullcontext
from pathlib import Path

import jax
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.loader import draw_ahead
from poem_jax.mixture.samples import Mixture
from poem_jax.training.bad_steps import BadSteps, positions_in
from poem_jax.training.checkpoints import Checkpoints
from poem_jax.training.config import TrainConfig
from poem_jax.training.hosts import any_host, is_first_host, names_lost_host
from poem_jax.training.initial_state import initial_state
from poem_jax.training.journal import PANELS, Journal
from poem_jax.training.pace import Pace
from poem_jax.training.parallel import (
    Step,
    check_batch_sizes,
    compile_step,
    data_mesh,
    put_batch,
    put_everywhere,
)
from poem_jax.training.pictures import image_grid
from poem_jax.training.preflight import check_before_training
from poem_jax.training.run_report import Sitting, reported
from poem_jax.training.source import (
    BatchAt,
    drawing_threads,
    open_training_data,
    training_batches,
)
from poem_jax.training.state import TrainState, restart_moments
from poem_jax.training.step import Metrics
from poem_jax.training.stopping import stop_after_the_step
from poem_jax.training.validation import Validation
from poem_jax.weights.store import flatten

STOP_EVERY = 4
"""Steps after which several hosts ask each other whether one of them must stop: it makes all wait for their
devices."""

log = logging.getLogger(__name__)


def train(config: TrainConfig, *, batch_at: BatchAt | None = None, command: str | None = None) -> TrainState:
    """Train, or go on from the newest checkpoint of `config.train.out`.

    Stops at `train.steps`, after `train.max_minutes`, or on SIGTERM or SIGINT; always with a checkpoint, and
    with a report in the run's folder.

    Args:
        config: the experiment.
        batch_at: source of the batches by step; None = what `config.data` says.
        command: the command line that goes on with the run, for what it says when it stops.

    Returns:
        The last state.

    Raises:
        FileNotFoundError: a data set of the config, or a file of it, is missing.
        FloatingPointError: a metric stopped being finite; names it, the step and its samples, and where the
            batch is; what is not finite goes into no checkpoint.
        HostLost: another host of the run has ended.
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
    sitting = Sitting(config, command)
    with (
        reported(sitting),
        names_lost_host(),
        Checkpoints(run_dir, config) as checkpoints,
        nullcontext(batch_at)
        if batch_at is not None
        else training_batches(config, mixture, begun=checkpoints.latest_step is not None) as draw,
    ):
        state = initial_state(config, checkpoints, mesh)
        sitting.begin(int(state.step), checkpoints)
        positions = positions_in(config.data) if batch_at is None else None
        key_at = None if mixture is None else mixture.key_at
        bad_steps = BadSteps(run_dir, config.train.skip_bad_steps, draw, positions, key_at, sitting.left_out)
        batches = draw_ahead(
            draw, sitting.step, ahead=config.data.prefetch, workers=drawing_threads(config.data)
        )
        with (
            closing(batches),
            Journal(run_dir, config, sitting.step) as journal,
            Pace() as pace,
            stop_after_the_step() as stopped,
        ):
            run = _Run(sitting, mesh, checkpoints, journal, pace, bad_steps, mixture)
            return run.go(state, batches, stopped)


class _Run:
    """One sitting of a run."""

    def __init__(
        self,
        sitting: Sitting,
        mesh: jax.sharding.Mesh,
        checkpoints: Checkpoints,
        journal: Journal,
        pace: Pace,
        bad_steps: BadSteps,
        mixture: Mixture | None,
    ) -> None:
        self.sitting, self.config, self.mesh = sitting, sitting.config, mesh
        self.checkpoints, self.journal, self.pace, self.bad_steps = checkpoints, journal, pace, bad_steps
        self.first_stage_step: Step = compile_step(self.config, mesh, first_stage=True)
        self.whole_step: Step = compile_step(self.config, mesh)
        options = self.config.train
        looks = options.validate_every or options.panel_every
        self.validation = Validation(self.config, mesh, mixture) if looks else None
        self.score: float | None = None
        """Of the newest state, if it has been validated."""
        self.unread: list[tuple[int, Metrics]] = []
        self.described = False
        self.compiled: set[tuple[bool, tuple[int, ...]]] = set()

    def go(
        self, state: TrainState, batches: Generator[MultiViewBatch], stopped: threading.Event
    ) -> TrainState:
        """Step until the end, the time limit or a signal; return the last state."""
        options = self.config.train
        key = put_everywhere(jax.random.key(options.seed + 1), self.mesh)
        step, coming = self.sitting.step, None
        if step == 0 and self._has_something_to_beat():
            self._measure_the_start(state)
        while step < options.steps and not self._should_stop(step, stopped):
            if step == self.config.first_stage_steps > 0:
                self._read_metrics()
                state = restart_moments(state)
            batch = self._place_next(step, batches) if coming is None else coming
            state = self._step(step, state, batch, key)
            step += 1
            try:
                # The next batch goes to the devices while they work on this one; one, not more.
                wanted = step < options.steps and not stopped.is_set()
                coming = self._place_next(step, batches) if wanted else None
            except Exception:
                # There is no next step, but this one is whole.
                self._look_and_keep(step, state)
                raise
            self._look_and_keep(step, state)
        self._checkpoint(state, wait=True)
        log.info("stopped after step %d of %d", step, options.steps)
        if step < options.steps:
            log.info("to go on: %s", self.sitting.how_to_go_on)
        return state

    def _has_something_to_beat(self) -> bool:
        """Say whether a run begins with a model, and watches frames or a score that it may make worse."""
        options, mixture = self.config.train, self.config.data.mixture
        holds_out = mixture is not None and any(part.held_out for part in mixture.parts)
        return bool(options.init_from and options.validate_every and (options.keep_best or holds_out))

    def _measure_the_start(self, state: TrainState) -> None:
        """Validate what `init_from` brought: it may be the best there is."""
        self._validate(0, state)
        if self.config.train.keep_best:
            self._checkpoint(state)

    def _place_next(self, step: int, batches: Generator[MultiViewBatch]) -> MultiViewBatch:
        with self.pace.waiting():
            batch = next(batches)
        self._describe(step, batch)
        return put_batch(batch, self.mesh)

    def _step(self, step: int, state: TrainState, batch: MultiViewBatch, key: jax.Array) -> TrainState:
        first_stage = step < self.config.first_stage_steps
        step_function = self.first_stage_step if first_stage else self.whole_step
        self._announce(first_stage, batch.views.shape)
        with jax.transfer_guard("disallow"):
            state, metrics = step_function(state, batch, key)
        self.pace.started(metrics["loss"], len(batch.views))
        self.unread.append((step, metrics))
        if len(self.unread) > 1:
            # The host stays one step ahead of the devices, not more.
            jax.block_until_ready(self.unread[-2][1]["loss"])
        self.checkpoints.confirm_write()
        self.journal.advance()
        self.sitting.step, self.score = step + 1, None
        return state

    def _look_and_keep(self, step: int, state: TrainState) -> None:
        """After a step: metrics, validation, picture and checkpoint, each at its own steps."""
        options = self.config.train
        whole = step > self.config.first_stage_steps
        if step % options.log_every == 0:
            self._read_metrics()
        validated = whole and options.validate_every and step % options.validate_every == 0
        if validated:
            self._validate(step, state)
        if whole and options.panel_every and step % options.panel_every == 0:
            self._draw_panel(step, state)
        if step % options.checkpoint_every == 0 or (validated and options.keep_best):
            self._checkpoint(state)

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
        fetched = [
            (step, {name: float(value) for name, value in metrics.items()})
            for step, metrics in jax.device_get(self.unread)
        ]
        self.unread = []
        good = self.bad_steps.check(fetched)
        means = {name: float(np.mean([metrics[name] for metrics in good])) for name in (good or [{}])[0]}
        if self.config.train.skip_bad_steps:
            means["bad_steps"] = float(len(fetched) - len(good))
        self.journal.write(fetched[-1][0] + 1, means | self.pace.read())

    def _validate(self, step: int, state: TrainState) -> None:
        assert self.validation is not None
        self._read_metrics()
        errors = self.validation(state)
        self.score = self.validation.score(errors)
        self.journal.write(step, errors, group="validation")
        self.pace.restart()

    def _draw_panel(self, step: int, state: TrainState) -> None:
        assert self.validation is not None
        self._read_metrics()
        if is_first_host():
            file = Path(PANELS) / f"step_{step:07d}.png"
            self.journal.image(step, "held_out", file, self.validation.panel(state))
        self.pace.restart()

    def _checkpoint(self, state: TrainState, *, wait: bool = False) -> None:
        self._read_metrics()
        self.checkpoints.save(state, wait=wait, score=self.score)

    def _describe(self, step: int, batch: MultiViewBatch) -> None:
        """Log what goes in, once a sitting; at step 0 keep a picture of it."""
        if self.described:
            return
        self.described = True
        log.info("batch %s", {name: np.shape(leaf) for name, leaf in flatten(batch).items()})
        if step == 0:
            self.journal.image(step, "input", Path("input_step0.png"), image_grid(batch.views))

    def _should_stop(self, step: int, stopped: threading.Event) -> bool:
        if jax.process_count() > 1 and step % STOP_EVERY:
            return False
        limit = self.config.train.max_minutes
        late = limit is not None and time.monotonic() - self.sitting.start > 60 * limit
        stops = any_host(stopped.is_set() or late)
        if stops and not late:
            self.sitting.stopped_early = "stopped by another host: a signal, or its `train.max_minutes`"
        return stops
