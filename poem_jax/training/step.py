"""One step of training: a pure function that also runs under `jax.pmap`, `shard_map` and a device mesh."""

from functools import partial

import jax
import jax.numpy as jnp
import optax

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import ROOT_JOINT, WRIST
from poem_jax.losses import (
    WHOLE,
    Share,
    keypoint_terms,
    match_keypoints,
    multi_view_losses,
    valid_masks,
    weighted,
)
from poem_jax.models.layers import DecoderRow, TrunkRow
from poem_jax.models.network import forward
from poem_jax.models.precision import cast_weights
from poem_jax.training.accumulation import Part, add_up, in_parts
from poem_jax.training.config import Precision, Rematerialise, RootSource, TrainConfig, TrainingRoot
from poem_jax.training.state import TrainState, learning_rate, make_optimizer, update_average
from poem_jax.typing import Array, Bool, Float, Params, PRNGKeyArray, PyTree

Metrics = dict[str, Array]

RECOMPUTED = {
    Rematerialise.NOTHING: (),
    Rematerialise.TRUNK: (TrunkRow,),
    Rematerialise.DECODER: (DecoderRow,),
    Rematerialise.BOTH: (TrunkRow, DecoderRow),
}
"""Rows whose blocks compute their insides again."""


def train_step(
    state: TrainState,
    batch: MultiViewBatch,
    key: PRNGKeyArray,
    *,
    config: TrainConfig,
    axis_name: str | None = None,
    first_stage: bool = False,
) -> tuple[TrainState, Metrics]:
    """Take one optimiser step.

    Args:
        state: weights, optimiser and step number; may be donated.
        batch: this device's part of the batch; masked views and samples have no influence.
        key: base key of the run; folded with `state.step` here, so that a resumed run draws the same numbers.
        config: the experiment; static.
        axis_name: mapped axis over which the batch is split. Sums over it make the result that of one device
            with the whole batch, also where the parts hold different numbers of valid views or samples.
        first_stage: train the heat maps alone; the compiler then drops the decoder.

    Returns:
        The next state, and scalar metrics of this step, equal on all devices. Where `train.skip_bad_steps`
        allows any, `bad_step` among them is 1 if the loss, the gradient or a statistic is not finite; the
        state is then the one before, but for its step and that of the learning rate.

    Raises:
        ValueError: the samples cannot be taken in `compute.accumulate` equal parts.
    """
    noise_key, model_key = jax.random.split(jax.random.fold_in(key, state.step))
    draw_key = jax.random.fold_in(model_key, 1) if config.model.grid_draw else None
    root_world = None
    if config.model.takes_root:
        root_world = noisy_root(batch.joints_world, config.training_root, key=noise_key, axis_name=axis_name)
    if root_world is not None and config.training_root.source is RootSource.TRIANGULATED:
        # A root that is NaN is triangulated; one view alone cannot do it.
        several = jnp.sum(batch.cameras.view_mask, -1) > 1
        root_world = jnp.where(several[:, None], jnp.nan, root_world)
    if axis_name is not None:
        model_key = jax.random.fold_in(model_key, jax.lax.axis_index(axis_name))
    whole = Part(batch, root_world, model_key)
    loss_share = partial(
        _loss_share, config=config, draw_key=draw_key, axis_name=axis_name, first_stage=first_stage
    )

    def gradient_of(part: Part, statistics: Params) -> tuple[Params, tuple[Metrics, Params]]:
        fixed = {**state.params, "statistics": statistics}
        return jax.grad(loss_share, has_aux=True)(state.params["trainable"], fixed, part)

    statistics = state.params["statistics"]
    if config.compute.accumulate == 1:
        gradients, (metrics, statistics) = gradient_of(whole, statistics)
    else:
        parts = in_parts(whole, config.compute.accumulate, axis_name)
        gradients, (metrics, statistics) = add_up(gradient_of, parts, statistics)
    if axis_name is not None:
        gradients, metrics = jax.lax.psum((gradients, metrics), axis_name)
    metrics["gradient_norm"] = optax.tree.norm(gradients)
    metrics["learning_rate"] = jnp.asarray(learning_rate(config)(state.step))
    after = _updated(state, gradients, statistics, config)
    if config.train.skip_bad_steps:
        is_finite = all_finite((metrics["loss"], metrics["gradient_norm"], statistics))
        metrics["bad_step"] = 1.0 - is_finite
        after = left_out_unless(is_finite, after, state)
    return after, metrics


def _loss_share(
    trainable: Params,
    fixed: Params,
    part: Part,
    *,
    config: TrainConfig,
    draw_key: PRNGKeyArray | None,
    axis_name: str | None,
    first_stage: bool,
) -> tuple[Array, tuple[Metrics, Params]]:
    """Return this part's share of the loss, its metrics, and the next statistics; `fixed`: the parameters
    whose trainable ones stand aside."""
    batch, share = part.batch, Share(axis_name, part.views, part.samples)
    params = {**fixed, "trainable": trainable}
    if config.compute.precision is Precision.BFLOAT16:
        params = cast_weights(params, config.model, jnp.bfloat16)
    prediction, statistics = forward(
        params,
        batch.views,
        existing_views(batch),
        config=config.model,
        root_world=part.root_world,
        train=True,
        frozen=config.frozen,
        key=part.key,
        draw_key=draw_key,
        axis_name=axis_name,
        recomputed=RECOMPUTED[config.compute.rematerialise],
    )
    image_hw = batch.views.shape[-3:-1]
    if first_stage:
        terms = keypoint_terms(prediction, batch, image_hw=image_hw, recipe=config.loss, share=share)
        loss = weighted(terms, config.loss)
        errors = keypoint_error(prediction, batch, share=share)
    else:
        loss, terms = multi_view_losses(
            near_the_hand(prediction, batch, config.training_root.max_error_m),
            batch,
            hand=HandModel(**fixed["constants"]["hand"]),
            image_hw=image_hw,
            recipe=config.loss,
            query_order=config.model.query_order,
            share=share,
        )
        errors = error_metrics(prediction, batch, share=share)
    return loss, ({"loss": loss, **terms, **errors}, statistics)


def existing_views(batch: MultiViewBatch) -> Cameras:
    """Mask the views of padded samples too, so that they stay out of the batch norm's moments."""
    K, T_cam_from_world, view_mask = batch.cameras
    if batch.sample_mask is not None:
        view_mask = view_mask & batch.sample_mask[:, None]
    return Cameras(K, T_cam_from_world, view_mask)


def noisy_root(
    joints_world: Float[Array, "batch 21 3"],
    noise: TrainingRoot,
    *,
    key: PRNGKeyArray,
    axis_name: str | None = None,
) -> Float[Array, "batch 3"]:
    """Disturb the true root joint, as the second stage must live with the first stage's errors.

    The released code adds noise to all joints and scales them about the noisy wrist, then uses the root
    only. Numbers belong to a sample's global index, so that splitting the batch changes none.
    """
    batch_size = joints_world.shape[0]
    first = 0 if axis_name is None else jax.lax.axis_index(axis_name) * batch_size
    sample_key, shared_key, scale_key = jax.random.split(key, 3)
    keys = jax.vmap(lambda i: jax.random.fold_in(sample_key, i))(first + jnp.arange(batch_size))
    offsets = jax.vmap(lambda k: jax.random.normal(k, (2, 3)))(keys) * noise.per_coordinate_m
    offsets += noise.shared_m * jax.random.normal(shared_key)
    root = joints_world[:, ROOT_JOINT] + offsets[:, 0]
    wrist = joints_world[:, WRIST] + offsets[:, 1]
    return wrist + (1.0 + noise.scale * jax.random.uniform(scale_key, minval=-1.0)) * (root - wrist)


def near_the_hand(prediction: Prediction, batch: MultiViewBatch, max_error_m: float | None) -> Prediction:
    """Mark samples as unsolved whose root is farther than this from the true one
    (`TrainingRoot.max_error_m`); a model without a root keeps all."""
    if prediction.root_world is None or max_error_m is None:
        return prediction
    near = _distance(prediction.root_world, batch.joints_world[:, ROOT_JOINT]) < max_error_m
    return prediction._replace(valid=prediction.valid & near)


def error_metrics(prediction: Prediction, batch: MultiViewBatch, *, share: Share = WHOLE) -> Metrics:
    """Compute the errors a reader of the log understands, shares of the whole batch's means."""
    _, sample_mask = valid_masks(prediction, batch)
    vertices = _distance(prediction.vertices_world, batch.vertices_world)
    joints = _distance(prediction.joints_world, batch.joints_world)
    return {
        "mpvpe_mm": 1000.0 * share.over_samples(vertices, sample_mask),
        "mpjpe_mm": 1000.0 * share.over_samples(joints, sample_mask),
        **keypoint_error(prediction, batch, share=share),
    }


def keypoint_error(prediction: Prediction, batch: MultiViewBatch, *, share: Share = WHOLE) -> Metrics:
    """Compute the heat maps' mean error in pixels, a share as in `error_metrics`; nothing without heat
    maps."""
    if prediction.keypoints_px is None:
        return {}
    view_mask, _ = valid_masks(prediction, batch)
    distance = _distance(prediction.keypoints_px, match_keypoints(prediction.keypoints_px, batch))
    return {"keypoint_px": share.over_views(distance, view_mask)}


def _distance(a: Array, b: Array) -> Array:
    return jnp.linalg.norm(jax.lax.stop_gradient(a) - b, axis=-1)


def _updated(state: TrainState, gradients: Params, statistics: Params, config: TrainConfig) -> TrainState:
    """Apply the optimiser and move the averages."""
    trainable = state.params["trainable"]
    updates, opt_state = make_optimizer(config).update(gradients, state.opt_state, trainable)
    params = {**state.params, "trainable": optax.apply_updates(trainable, updates), "statistics": statistics}
    ema = state.ema
    if ema is not None:
        ema = update_average(ema, params, state.step, config.optimizer.ema_decay)
    return TrainState(state.step + 1, params, opt_state, ema)


def all_finite(tree: PyTree) -> Bool[Array, ""]:
    """Say whether every number of a tree is finite."""
    return jnp.all(jnp.array([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]))


def left_out_unless(is_finite: Bool[Array, ""], after: TrainState, before: TrainState) -> TrainState:
    """Return the state after a step, or the one before with the step counted, also for the learning rate:
    its schedule would else fall behind the run."""

    def chosen(new: PyTree, old: PyTree) -> PyTree:
        if isinstance(new, optax.ScaleByScheduleState):
            return new
        return jax.tree.map(lambda a, b: jnp.where(is_finite, a, b), new, old)

    is_schedule = lambda entry: isinstance(entry, optax.ScaleByScheduleState)  # noqa: E731
    kept = jax.tree.map(chosen, after, before, is_leaf=is_schedule)
    return kept._replace(step=after.step)
