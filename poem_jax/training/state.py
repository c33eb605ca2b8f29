"""What training carries from step to step, and the optimiser that moves it."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from poem_jax.models.backbones import stacked_axes
from poem_jax.training.config import Clip, OptimizerConfig, Schedule, TrainConfig
from poem_jax.typing import Array, Int, Params, PyTree


class TrainState(NamedTuple):
    """Everything a checkpoint holds."""

    step: Int[Array, ""]
    """Number of finished steps."""
    params: Params
    """`trainable`, `statistics` and `constants`."""
    opt_state: PyTree
    ema: Params | None
    """Moving averages of `trainable` and `statistics`, or None."""


def create_state(params: Params, config: TrainConfig) -> TrainState:
    """Start training from `params` at step 0."""
    # Copies, since the state will be donated. Of explicit dtype, since the weakly typed constants of an
    # initialiser would compile the step a second time.
    params = jax.tree.map(lambda leaf: jnp.array(leaf, leaf.dtype), params)
    ema = jax.tree.map(jnp.copy, _averaged(params)) if config.optimizer.ema_decay else None
    opt_state = make_optimizer(config).init(params["trainable"])
    return TrainState(jnp.zeros((), jnp.int32), params, opt_state, ema)


def evaluation_params(state: TrainState) -> Params:
    """Return the parameters to evaluate and ship: the moving averages where they are kept."""
    return state.params if state.ema is None else {**state.params, **state.ema}


def make_optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """Build Adam with the schedule and the clipping of the config."""
    options = config.optimizer
    transforms = [_clipping(options), optax.scale_by_adam(options.b1, options.b2, options.eps)]
    if options.weight_decay:
        transforms.append(optax.add_decayed_weights(options.weight_decay, mask=_is_matrix))
    return optax.chain(*transforms, optax.scale_by_learning_rate(learning_rate(config)))


def restart_moments(state: TrainState) -> TrainState:
    """Forget Adam's moments, but not the step: weights that had no gradient so far would else leap, their
    second moments being zero long after the bias correction has ended."""

    def restart(entry: PyTree) -> PyTree:
        return jax.tree.map(jnp.zeros_like, entry) if isinstance(entry, optax.ScaleByAdamState) else entry

    is_adam = lambda entry: isinstance(entry, optax.ScaleByAdamState)  # noqa: E731
    return state._replace(opt_state=jax.tree.map(restart, state.opt_state, is_leaf=is_adam))


def learning_rate(config: TrainConfig) -> optax.Schedule:
    """Return the learning rate as a function of the number of finished steps; each stage has its own warm-up
    and decay."""
    options, first = config.optimizer, config.first_stage_steps
    rest = _one_schedule(options, options.learning_rate, (options.decay_steps or config.train.steps) - first)
    if not first:
        return rest
    peak = options.first_stage_learning_rate or options.learning_rate
    return optax.join_schedules([_one_schedule(options, peak, first), rest], [first])


def _one_schedule(options: OptimizerConfig, peak: float, steps: int) -> optax.Schedule:
    warmup = options.warmup_steps
    if options.schedule is Schedule.COSINE:
        main = optax.cosine_decay_schedule(peak, max(steps - warmup, 1), options.final_ratio)
    elif options.schedule is Schedule.STEP:
        main = optax.piecewise_constant_schedule(peak, {max(round(steps * options.drop_at) - warmup, 0): 0.1})
    else:
        main = optax.constant_schedule(peak)
    if not warmup:
        return main
    return optax.join_schedules([optax.linear_schedule(peak / warmup, peak, warmup), main], [warmup])


def clip_each_tensor(max_norm: float) -> optax.GradientTransformation:
    """Limit the norm of every gradient tensor on its own, as the released training code does.

    Equal blocks whose weights are stacked in one array count as so many tensors.
    """

    def clip(path: Any, gradient: Array) -> Array:
        axes = tuple(range(stacked_axes([part.key for part in path]), gradient.ndim))
        norm = jnp.sqrt(jnp.sum(gradient**2, axes, keepdims=True))
        return gradient * jnp.minimum(1.0, max_norm / (norm + 1e-6))

    return optax.stateless(lambda gradients, _: jax.tree_util.tree_map_with_path(clip, gradients))


def update_average(average: Params, params: Params, step: Array, decay: float) -> Params:
    """Move the averages towards the parameters; young averages move faster, so that they forget the start."""
    decay_now = jnp.minimum(decay, (1.0 + step) / (10.0 + step))
    return jax.tree.map(lambda a, p: a + (1.0 - decay_now) * (p - a), average, _averaged(params))


def _averaged(params: Params) -> Params:
    return {name: params[name] for name in ("trainable", "statistics")}


def _clipping(options: OptimizerConfig) -> optax.GradientTransformation:
    if options.clip is Clip.GLOBAL:
        return optax.clip_by_global_norm(options.clip_norm)
    if options.clip is Clip.PER_TENSOR:
        return clip_each_tensor(options.clip_norm)
    return optax.identity()


def _is_matrix(params: PyTree) -> PyTree:
    """Biases and scales are not decayed."""
    return jax.tree.map(lambda p: p.ndim > 1, params)
