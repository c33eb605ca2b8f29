"""However a step is computed, it is the same step: part by part, with less memory, or in half numbers."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand import default_hand
from poem_jax.losses import RELEASE, Share, multi_view_losses
from poem_jax.models.layers import DecoderRow, Exact, TrunkRow
from poem_jax.models.network import describe, forward, weights_of_kind
from poem_jax.models.precision import cast_weights
from poem_jax.models.presets import PRESETS
from poem_jax.training.accumulation import Part, add_up, in_parts
from poem_jax.training.config import (
    ComputeConfig,
    OptimizerConfig,
    Precision,
    Rematerialise,
    Schedule,
    TrainConfig,
)
from poem_jax.training.state import TrainState, create_state, learning_rate, make_optimizer
from poem_jax.training.step import all_finite, left_out_unless, train_step
from tests.precision import products
from tests.small_presets import NUM_VIEWS, small
from tests.training.conftest import HW, MICRO

KEY = jax.random.key(3)
BOTH = (TrunkRow, DecoderRow)
HALF = ComputeConfig(precision=Precision.BFLOAT16)


@pytest.fixture
def config(micro_config) -> TrainConfig:
    """Equal in all tests, so that they share what is compiled. The views are frozen, which leaves no batch
    norm, and the larger half of the program out; `learned_whole` puts them back."""
    return replace(
        micro_config,
        frozen_views=True,
        optimizer=OptimizerConfig(learning_rate=1e-3, schedule=Schedule.CONSTANT, ema_decay=0.9),
        train=replace(micro_config.train, out="unused", init_from="somewhere"),
    )


def computed(config: TrainConfig, **changes) -> TrainConfig:
    return replace(config, compute=replace(config.compute, **changes))


def learned_whole(config: TrainConfig) -> TrainConfig:
    return replace(config, frozen_views=False)


def compiled(config: TrainConfig, state: TrainState, batch):
    return jax.jit(partial(train_step, config=config)).lower(state, batch, KEY).compile()


def first_moments(state: TrainState):
    """Adam's, after one step: the gradient, clipped, times 0.1."""
    return optax.tree.get(state.opt_state, "mu")


def assert_same_gradients(got: TrainState, wanted: TrainState, relative: float) -> None:
    got, wanted = first_moments(got), first_moments(wanted)
    scale = float(optax.tree.norm(wanted))
    assert scale > 0
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=relative * scale)


@pytest.fixture
def uneven(micro_batch):
    """Parts of 10 and 5 of the views, of four and two of the samples."""
    mask = np.array(micro_batch.cameras.view_mask)
    mask[1, 2] = mask[2, 0] = mask[6, 1] = False
    sample_mask = np.ones(len(mask), bool)
    sample_mask[[3, 5]] = False
    K, T, _ = micro_batch.cameras
    return micro_batch._replace(cameras=Cameras(K, T, mask), sample_mask=sample_mask)


def test_parts_add_up_to_the_whole(uneven):
    """The gradient of two parts is that of the batch, and so are its terms, for a model of three offsets.
    Unweighted, the parts' means would be off by 10 % and more."""
    offsets = {
        "vertices": jnp.array([0.03, 0, 0]),
        "joints": jnp.array([0, 0.02, 0]),
        "px": jnp.array([1, 2.0]),
    }

    def gradient_of(part: Part, statistics):
        def loss(offsets):
            batch, share = part.batch, Share(None, part.views, part.samples)
            found = off_by(offsets, batch)
            options = {"hand": default_hand(), "image_hw": HW, "recipe": RELEASE, "share": share}
            loss, terms = multi_view_losses(found, batch, **options)
            return loss, (terms, statistics)

        return jax.grad(loss, has_aux=True)(offsets)

    @jax.jit
    def both(whole: Part):
        parts = in_parts(whole, 2)
        return gradient_of(whole, {}), add_up(gradient_of, parts, {}), parts

    (wanted, (terms, _)), (got, (of_parts, _)), parts = both(Part(uneven, None, KEY))
    np.testing.assert_allclose(parts.views, [10 / 15, 5 / 15], rtol=1e-6)
    np.testing.assert_allclose(parts.samples, [4 / 6, 2 / 6], rtol=1e-6)
    tolerance = {"rtol": 1e-5, "atol": 1e-6}
    jax.tree.map(partial(np.testing.assert_allclose, **tolerance), (got, of_parts), (wanted, terms))


def off_by(offsets, batch) -> Prediction:
    """The truth, but for offsets and a disturbance of each sample's own."""

    def moved(truth, offset, scale):
        return truth + offset + scale * jnp.sin(1000 * truth)

    vertices = moved(batch.vertices_world, offsets["vertices"], 0.01)
    joints = moved(batch.joints_world, offsets["joints"], 0.01)
    keypoints = moved(batch.keypoints_px, offsets["px"], 1.0)
    return Prediction(vertices, joints, None, keypoints, vertices[:, None], jnp.ones(len(joints), bool))


@pytest.mark.slow
def test_a_step_in_parts_is_the_step(drawn_params, config, uneven):
    """Without batch norms, and in less memory; with the decoder's layers computed again, too. A batch with a
    NaN among its labels moves nothing but the number of the step."""
    in_two = computed(config, accumulate=2, rematerialise=Rematerialise.DECODER)
    in_two = replace(in_two, train=replace(in_two.train, skip_bad_steps=1))
    state = create_state(drawn_params, config)
    once, parts = (compiled(chosen, state, uneven) for chosen in (config, in_two))
    (wanted, wanted_metrics), (got, metrics) = (run(state, uneven, KEY) for run in (once, parts))
    assert_same_gradients(got, wanted, 1e-5)
    assert metrics.pop("bad_step") == 0
    for name, value in wanted_metrics.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-5, err_msg=name)
    assert temporary_bytes(parts) < 0.75 * temporary_bytes(once)

    labels = np.array(uneven.vertices_world)
    labels[0, 0] = np.nan
    after, metrics = parts(state, uneven._replace(vertices_world=labels), KEY)
    assert metrics["bad_step"] == 1
    assert after.step == state.step + 1
    counted = optax.ScaleByScheduleState(np.int32(1))
    as_before = state._replace(step=after.step, opt_state=(*state.opt_state[:-1], counted))
    jax.tree.map(np.testing.assert_array_equal, after, as_before)


def test_a_step_that_is_not_finite_is_left_out():
    """Nothing moves but the number of the step."""
    before = TrainState(jnp.array(4), {"trainable": jnp.array([1.0, 2.0])}, (jnp.array(3),), None)
    after = TrainState(jnp.array(5), {"trainable": jnp.array([jnp.nan, 3.0])}, (jnp.array(4),), None)
    kept = left_out_unless(jnp.array(False), after, before)
    jax.tree.map(np.testing.assert_array_equal, kept, before._replace(step=jnp.array(5)))
    jax.tree.map(np.testing.assert_array_equal, left_out_unless(jnp.array(True), after, before), after)


def test_the_rate_of_a_warm_up_is_that_of_the_step_whatever_was_left_out(config):
    """Adam moves a weight of constant gradient by the learning rate, which the log says."""
    options = OptimizerConfig(learning_rate=0.1, schedule=Schedule.COSINE, warmup_steps=5, eps=0.0)
    config = replace(config, optimizer=options)
    optimizer, gradient = make_optimizer(config), {"w": jnp.array([0.5])}
    params = {"trainable": {"w": jnp.zeros(1)}, "statistics": {}}
    state = TrainState(jnp.zeros((), jnp.int32), params, optimizer.init(params["trainable"]), None)

    @jax.jit
    def take(state, is_good):
        updates, opt_state = optimizer.update(gradient, state.opt_state, state.params["trainable"])
        after = state._replace(step=state.step + 1, opt_state=opt_state)
        return left_out_unless(is_good, after, state), updates["w"], learning_rate(config)(state.step)

    for step in range(6):
        state, moved, rate = take(state, step not in (1, 2))
        np.testing.assert_allclose(moved, -rate, rtol=1e-4)
    assert optax.tree.get(state.opt_state, "mu")["w"] == pytest.approx(0.5 * (1 - 0.9**4), rel=1e-5)


def test_one_number_that_is_not_finite_is_found():
    tree = {"loss": jnp.array(1.0), "statistics": {"mean": jnp.zeros(3), "empty": {}}}
    assert all_finite(tree)
    assert all_finite({})
    for bad in (jnp.nan, jnp.inf):
        assert not all_finite(tree | {"statistics": {"mean": jnp.array([0.0, bad, 0.0])}})


def test_a_batch_that_has_no_equal_parts_is_refused(config, micro_batch):
    odd = jax.tree.map(lambda leaf: leaf[:7], micro_batch)
    with pytest.raises(ValueError, match=r"multiple of `compute\.accumulate` = 2; got 7 samples"):
        in_parts(Part(odd, None, KEY), 2)
    with pytest.raises(ValueError, match=r"times `compute\.accumulate` = 1 x 3; got \[8\]"):
        computed(config, accumulate=3)


def test_samples_that_depend_on_each_other_stay_together(config):
    model = PRESETS["mvp-release"]
    with pytest.raises(ValueError, match=r"`compute\.accumulate` must be 1 for this MvpConfig"):
        TrainConfig("odd", model, config.data, compute=ComputeConfig(accumulate=2))


@pytest.mark.slow
def test_half_numbers_cost_few_digits(drawn_params, config, micro_batch):
    """The loss of random weights changes by less than 1 %, the gradient's direction by less than 4 degrees;
    ten steps lower either loss."""
    runs = {}
    for chosen in (config, replace(config, compute=HALF)):
        state = create_state(drawn_params, chosen)
        step = compiled(chosen, state, micro_batch)
        state, first = step(state, micro_batch, KEY)
        gradient = jax.flatten_util.ravel_pytree(first_moments(state))[0]
        for _ in range(10):
            state, last = step(state, micro_batch, KEY)
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(state.params["trainable"]))
        runs[chosen.compute.precision] = float(first["loss"]), float(last["loss"]), np.array(gradient)
    (first, last, gradient), (half_first, half_last, half_gradient) = runs.values()
    np.testing.assert_allclose(half_first, first, rtol=0.01)
    assert half_first != first
    cosine = gradient @ half_gradient / np.linalg.norm(gradient) / np.linalg.norm(half_gradient)
    assert cosine > np.cos(np.radians(4))
    assert last < 0.995 * first
    assert half_last < 0.995 * half_first


KINDS = ["tiny", "v1", "v2-medium-mano-release", "ftl-meshtr", "mvp"]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "tiny" else pytest.mark.slow) for name in KINDS]
)
def test_half_numbers_reach_trunk_and_decoder_and_no_coordinate(name, batch_at):
    """Convolutions are all of half numbers but that to the heat maps; every product is, or is of full
    precision and gives coordinates; what the model gives is in float32."""
    model = MICRO if name == "tiny" else small(PRESETS[name])
    batch = batch_at(0, 1, NUM_VIEWS, 0.05)
    params = shapes_of(model)

    def found(params, views):
        root = batch.joints_world[:, 9] if model.takes_root else None
        halves = cast_weights(params, model)
        return forward(halves, views, batch.cameras, config=model, root_world=root, train=True, key=KEY)

    traced, shapes = jax.make_jaxpr(found, return_shape=True)(params, batch.views)
    assert {leaf.dtype for leaf in jax.tree.leaves(shapes) if leaf.dtype != bool} == {jnp.dtype("float32")}
    exact = jax.lax.Precision.HIGHEST
    kinds = [
        {variable.aval.dtype for variable in product.invars}
        for product in products(traced.jaxpr)
        if product.params["precision"] != (exact, exact)
    ]
    assert all(len(dtypes) == 1 for dtypes in kinds)
    few = sum(dtypes == {jnp.dtype("float32")} for dtypes in kinds)
    assert few <= 0.25 * len(kinds)


def shapes_of(model):
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), describe(model))


def test_exact_weights_are_those_of_norms_and_read_outs():
    names = {".".join(path) for path in weights_of_kind(MICRO, Exact)}
    assert {"heat_maps.to_logits.kernel", "decoder.layers.0.feed_forward.offset.kernel"} <= names
    assert "decoder.layers.0.norms.0.scale" in names
    assert not any("hidden" in name or name.endswith("conv.kernel") for name in names)


def test_less_is_kept_for_the_backward_pass(micro_batch):
    """By what JAX carries from the forward pass to the backward one: 17.1, 3.5 and 1.9 MB. XLA:CPU merges the
    two again, so that no program for a CPU shows it."""
    everything, of_trunk, little = (kept_bytes(micro_batch, kinds) for kinds in ((), (DecoderRow,), BOTH))
    assert of_trunk < 0.3 * everything
    assert little < 0.6 * of_trunk


def kept_bytes(batch, kinds) -> int:
    params = shapes_of(MICRO)

    def found(trainable):
        whole = {**params, "trainable": trainable}
        root = batch.joints_world[:, 9]
        options = {"config": MICRO, "root_world": root, "train": True, "recomputed": kinds}
        prediction, _ = forward(whole, batch.views, batch.cameras, **options)
        return prediction.layers_world, prediction.keypoints_px

    backward = jax.eval_shape(lambda trainable: jax.vjp(found, trainable)[1], params["trainable"])
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(backward))


@pytest.mark.slow
def test_computing_again_changes_nothing(drawn_params, config, micro_batch):
    config = learned_whole(config)
    state = create_state(drawn_params, config)
    lean = computed(config, rematerialise=Rematerialise.BOTH)
    kept, again = (compiled(chosen, state, micro_batch) for chosen in (config, lean))
    (wanted, wanted_metrics), (got, metrics) = (run(state, micro_batch, KEY) for run in (kept, again))
    assert_same_gradients(got, wanted, 1e-6)
    np.testing.assert_allclose(metrics["loss"], wanted_metrics["loss"], rtol=1e-6)
    close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-7)
    jax.tree.map(close, got.params["statistics"], wanted.params["statistics"])


def temporary_bytes(run) -> int:
    return run.memory_analysis().temp_size_in_bytes
