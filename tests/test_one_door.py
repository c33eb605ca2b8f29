"""Files, training, evaluation, captures and released weights with a system without root and key points."""

import dataclasses
import json
import logging
import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch
from poem_jax.capture.frame import Frame, HandCrops, HandResult
from poem_jax.capture.judge import judge_hands
from poem_jax.capture.network import make_network, predict_hands
from poem_jax.capture.take import Take
from poem_jax.cli.reconstruct import Reconstruct
from poem_jax.evaluation.benchmark import BenchmarkSettings, model_predictor, run_benchmark
from poem_jax.evaluation.stages import check_has_stages
from poem_jax.evaluation.tables import format_report
from poem_jax.geometry.rig import Rig
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.losses import MESH_TRANSFORMER, PAPER, V1
from poem_jax.models import presets
from poem_jax.models.apply import init
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.training.config import BatchShape, DataConfig, OptimizerConfig, RunConfig, Schedule, TrainConfig
from poem_jax.training.loop import train
from poem_jax.training.parallel import check_batch_sizes, data_mesh
from poem_jax.training.recipes import RECIPES, experiment
from poem_jax.training.source import validation_batches
from poem_jax.training.state import create_state, learning_rate
from poem_jax.training.step import train_step
from poem_jax.weights import torch_import
from poem_jax.weights.config_json import from_json, to_json
from poem_jax.weights.release_files import import_release
from poem_jax.weights.store import load, save
from poem_jax.weights.torch_import import convert, export_state_dict
from tests import stand_in
from tests.micro import MICRO
from tests.one_hand.capture import one_hand_folder
from tests.stand_in import StandInConfig

CONFIG = StandInConfig()


@pytest.fixture(autouse=True)
def system(monkeypatch):
    stand_in.register(monkeypatch)
    monkeypatch.setitem(presets.RELEASED, "stand-in", lambda dataset, num_views: CONFIG)
    monkeypatch.setitem(torch_import.KEYS, StandInConfig, "tests.stand_in_keys")


def params_of(config) -> dict:
    return init(config, key=jax.random.key(1))


# On disk.


def test_a_config_says_its_kind_and_poem_v2_needs_none():
    assert json.loads(to_json(CONFIG))["kind"] == "StandInConfig"
    for config in (CONFIG, StandInConfig(draws=True, views=4), StandInConfig(views=None)):
        assert from_json(to_json(config)) == config
    assert "kind" not in json.loads(to_json(MICRO))
    assert from_json(json.dumps({"kind": "Config", **json.loads(to_json(MICRO))})) == MICRO
    with pytest.raises(
        ValueError, match=r"`config.kind` must be one of \['Config', .*'StandInConfig'\]; got"
    ):
        from_json('{"kind": "Mine"}')
    with pytest.raises(ValueError, match=r"`config` has unknown keys \['width'\]"):
        from_json('{"kind": "StandInConfig", "width": 3}')


def test_what_is_saved_comes_back(tmp_path):
    params = params_of(CONFIG)
    save(tmp_path / "model", CONFIG, params)
    config, found = load(tmp_path / "model", expected=CONFIG)
    assert config == CONFIG
    jax.tree.map(np.testing.assert_array_equal, found, params)
    with pytest.raises(
        ValueError, match=r"checkpoint of another config .* expected a Config, got a StandInConfig"
    ):
        load(tmp_path / "model", expected=MICRO)


# Training and evaluation.


def experiment_of(loss=MESH_TRANSFORMER, **changed) -> TrainConfig:
    fields = {
        "name": "stand-in",
        "model": CONFIG,
        "data": DataConfig(
            synthetic=SyntheticConfig(image_hw=CONFIG.image_hw, num_views=2), batches=(BatchShape(2, 4),)
        ),
        "loss": loss,
        "optimizer": OptimizerConfig(learning_rate=1e-2, schedule=Schedule.CONSTANT),
    }
    return TrainConfig(**{**fields, **changed})


def batch_of(make_views: int = 2, samples: int = 4) -> MultiViewBatch:
    captures = SyntheticDataset(SyntheticConfig(image_hw=CONFIG.image_hw, num_views=make_views), seed=3)
    parts = [captures.sample(i) for i in range(samples)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *parts)


@pytest.mark.parametrize("model", [CONFIG, StandInConfig(draws=True)], ids=["plain", "draws"])
def test_it_learns(model):
    config = experiment_of(model=model)
    state, batch, losses = create_state(params_of(model), config), batch_of(), []
    step = jax.jit(lambda state, batch: train_step(state, batch, jax.random.key(0), config=config))
    for _ in range(30):
        state, metrics = step(state, batch)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < 0.7 * losses[0]
    assert {"keypoint_px", "keypoints", "triangulation"}.isdisjoint(metrics)
    assert metrics["mpvpe_mm"] > 0


@pytest.mark.parametrize(
    ("loss", "weight"), [(PAPER, "keypoints"), (replace(V1, keypoints=0.0), "triangulation")]
)
def test_a_loss_of_what_the_model_does_not_give(loss, weight):
    config = experiment_of(loss)
    state = create_state(params_of(CONFIG), config)
    with pytest.raises(ValueError, match=f"recipe {loss.name!r} weighs `{weight}` by 10, which the model"):
        train_step(state, batch_of(), jax.random.key(0), config=config)


def test_experiments_that_the_system_cannot_follow():
    with pytest.raises(ValueError, match="`first_stage_steps` must be 0 for a StandInConfig without"):
        experiment_of(first_stage_steps=10)
    with pytest.raises(ValueError, match=r"must be 4, as the layers of this StandInConfig.*got \[2\]"):
        experiment_of(model=StandInConfig(views=4))
    with pytest.raises(ValueError, match=r"must not exceed 2, which the layers.*got \(2, 4, 8\)"):
        experiment_of(model=StandInConfig(views=2), train=RunConfig(validate_every=1))


def test_samples_that_depend_on_each_other_stay_on_one_device(tmp_path):
    run = RunConfig(out=str(tmp_path / "run"))
    config = experiment_of(model=StandInConfig(coupled=True), train=run)
    assert jax.device_count() == 2
    with pytest.raises(ValueError, match=r"this StandInConfig must stay on one device, .* got 2 devices"):
        train(config)
    check_batch_sizes(config, data_mesh(jax.devices()[:1]))
    check_batch_sizes(replace(config, model=CONFIG), data_mesh())


def test_a_model_for_two_views_is_evaluated_and_validated_with_one():
    model = StandInConfig(views=2)
    run = RunConfig(validate_every=1, validation_samples=1, validation_views=(1, 2))
    config = experiment_of(model=model, train=run)
    for views in (1, 2):
        (batch,) = validation_batches(config, views)
        np.testing.assert_array_equal(batch.cameras.view_mask.sum(-1), views)
        assert batch.views.shape[1] == 2
    predict = (model_predictor(params_of(model), config) for config in (model, CONFIG))
    padded, free = (f(batch_of(1)).found.vertices_world for f in predict)
    np.testing.assert_allclose(padded, free, atol=1e-6)


def test_the_recipes_drop_the_rate_where_the_release_does():
    """Epoch 70 of 101, 32 of 101 for FTL-MeshTR and 70 of 100 for PE-MeshTR; the paper at 70 %."""
    data = experiment_of().data
    dropped = {
        "v1-release": (70, 101),
        "pe-meshtr-release": (70, 100),
        "ftl-meshtr-release": (32, 101),
        "mvp-release": (70, 101),
    }
    for name, (epoch, epochs) in dropped.items():
        run = RunConfig(steps=50 * epochs)
        config = experiment(name, name=name, model=CONFIG, data=data, train=run)
        rate = learning_rate(config)
        assert rate(50 * epoch - 1) == pytest.approx(1e-4)
        assert rate(50 * epoch + 1) == pytest.approx(1e-5)
        assert config.optimizer.clip.value == "per_tensor"
        assert config.optimizer.clip_norm == 1.0
    paper = experiment("v1", name="v1", model=CONFIG, data=data, train=RunConfig(steps=1000))
    assert learning_rate(paper)(699) == pytest.approx(1e-4)
    assert learning_rate(paper)(701) == pytest.approx(1e-5)
    for name in ("v1", "v1-release"):
        assert RECIPES[name].loss is V1


def test_its_row_of_the_benchmark_has_no_root():
    captures = SyntheticDataset(SyntheticConfig(image_hw=CONFIG.image_hw, num_views=2), seed=3)
    settings = BenchmarkSettings(views=(1, 2), samples=2, batch_size=2, progress=False)
    predict = model_predictor(params_of(CONFIG), CONFIG)
    results = run_benchmark(predict, captures, settings)
    for scores in results.values():
        assert scores["root_error_mm"] is None
        assert scores["mpvpe_true_root_mm"] is None
        assert scores["median_mpvpe_true_root_mm"] is None
        assert scores["mpvpe_mm"] > 0
        assert scores["unsolved"] == 0
    assert "true root   " not in format_report(results).splitlines()[8]
    with pytest.raises(
        ValueError, match="stages can be told apart in POEM v2's models only; got a StandInConfig"
    ):
        check_has_stages(CONFIG)


def test_a_model_that_triangulates_and_takes_no_root_cannot_do_with_one_view():
    @dataclasses.dataclass(frozen=True)
    class Rays(StandInConfig):
        triangulates: bool = True

    with pytest.raises(ValueError, match=r"Rays needs two views or more.*leave 1 out of the view counts"):
        model_predictor({}, Rays())(batch_of(1))


# Captures.


def capture(views: int, seen: int):
    """A rig of cameras that see one left hand's crops in the first views."""
    size = np.tile([64, 64], (views, 1))
    K = np.tile(np.array([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]]), (views, 1, 1))
    T = np.tile(np.eye(4), (views, 1, 1))
    T[:, 0, 3] = 0.1 * np.arange(views)
    rig = Rig(tuple(f"cam{i}" for i in range(views)), size, K, np.zeros((views, 5)), T)
    mask = np.arange(views) < seen
    crops = HandCrops(
        np.random.default_rng(0).integers(0, 256, (views, 32, 32, 3), dtype=np.uint8),
        (K / 2).astype(np.float32),
        T.astype(np.float32),
        mask,
    )
    frame = Frame("0", np.zeros((1, views, 4)), crops=(crops,), hands=(HandResult(mask),))
    return rig, frame, crops


@pytest.mark.parametrize("views", [1, 3])
def test_hands_of_a_capture_have_joint_9_for_a_root_and_no_pixels(views):
    rig, frame, crops = capture(3, views)
    params = params_of(CONFIG)
    for side in ("right", "left"):
        frames = predict_hands([frame], Take(rig, (side,), [frame]), make_network(CONFIG, params))
        (judged,) = judge_hands(frames, rig)
        (hand,) = judged.hands
        assert hand.reason is None
        np.testing.assert_array_equal(hand.root_world, hand.joints_world[ROOT_JOINT])
        assert hand.keypoints_px is None
        assert np.isnan(hand.reprojection_px).all()
        np.testing.assert_array_equal(np.isfinite(hand.joints_shown), crops.view_mask)


def test_a_hand_that_depends_on_its_batch_is_alone_in_it():
    config = StandInConfig(coupled=True)
    params = params_of(config)
    rig, frame, crops = capture(3, 3)
    brighter = frame._replace(crops=(crops._replace(views=255 - crops.views // 8),))

    def hand(frames):
        found = list(predict_hands(frames, Take(rig, ("left",), frames), make_network(config, params)))
        return found[0].hands[0].vertices_world

    np.testing.assert_allclose(hand([frame, brighter]), hand([frame]), atol=1e-7)


def test_a_rig_with_another_number_of_cameras_is_one_line():
    rig, frame, _ = capture(3, 3)
    config = StandInConfig(views=4)
    with pytest.raises(ValueError, match=r"the rig must have 4 cameras, .* got 3. Take a"):
        list(predict_hands([frame], Take(rig, ("right",), [frame]), make_network(config, params_of(config))))


def test_another_number_of_cameras_is_said_before_hands_are_looked_for(tmp_path):
    config = StandInConfig(views=8)
    save(tmp_path / "model", config, params_of(config))
    take = tmp_path / "take"
    shutil.copytree(one_hand_folder(), take, ignore=shutil.ignore_patterns("*.npz"))
    command = Reconstruct(take, tmp_path / "out", checkpoint=tmp_path / "model")
    with pytest.raises(ValueError, match=r"the rig must have 8 cameras, .* got 4"):
        command.run()
    assert not (tmp_path / "out").exists()


# Released weights.


def checkpoint() -> dict[str, np.ndarray]:
    return export_state_dict(CONFIG, params_of(CONFIG))


def test_a_checkpoint_goes_out_and_comes_back():
    params = params_of(CONFIG)
    state = export_state_dict(CONFIG, params)
    np.testing.assert_array_equal(state["head.move.0.weight"].T, params["trainable"]["move"]["kernel"])
    np.testing.assert_array_equal(state["head.move.1.weight"], state["head.move.0.weight"])
    for prefix in ("module.", ""):
        named = {prefix + name: array for name, array in state.items()}
        config, found = convert(named, "stand-in", mano=default_hand(), dataset="ho3d", num_views=5)
        assert config == CONFIG
        jax.tree.map(np.testing.assert_array_equal, found, params)
    with pytest.raises(ValueError, match="only the released models can be exported"):
        export_state_dict(replace(CONFIG, image_mean=0.25), params)


def test_the_hand_is_that_of_the_buffers_that_are_used(caplog):
    state = checkpoint()
    state["head.mano_layer.th_v_template"] = 1.1 * state["head.mano_layer.th_v_template"]
    state["mano_layer.th_v_template"] = 0 * state["mano_layer.th_v_template"]
    with caplog.at_level(logging.WARNING):
        _, params = convert(state, "stand-in", mano=default_hand())
    expected = 1.1 * default_hand().v_template
    np.testing.assert_allclose(params["constants"]["hand"]["v_template"], expected, rtol=1e-6)
    longest = np.ptp(default_hand().v_template, axis=0).max()
    assert np.ptp(params["constants"]["template"], axis=0).max() > 1.05 * longest
    assert "differs from `mano`" in caplog.text


def test_all_that_does_not_fit_is_one_error():
    state = checkpoint()
    del state["head.move.0.bias"], state["mano_layer.th_betas"]
    state["extra.weight"] = np.zeros(3, np.float32)
    state["fc.weight"] = np.zeros((10, 4), np.float32)
    state["head.move.1.weight"] = state["head.move.1.weight"] + 1
    with pytest.raises(ValueError, match="does not fit stand-in: 5 problems") as caught:
        convert(state, "stand-in", mano=default_hand())
    for part in (
        "head.move.0.bias: missing, expected for trainable.move.bias",
        "mano_layer.th_betas: missing, expected (1, 10)",
        "extra.weight: unknown, got shape (3,)",
        "fc.weight: expected shape (10, 3), got (10, 4)",
        "head.move.1.weight: expected the numbers of head.move.0.weight, of which it is another name",
    ):
        assert part in str(caught.value)


def test_a_variant_says_what_it_needs(monkeypatch):
    points = np.zeros((4096, 3), np.float32)
    with pytest.raises(ValueError, match="for stand-in `basis_points` must be None"):
        convert(checkpoint(), "stand-in", mano=default_hand(), basis_points=points)
    with pytest.raises(ValueError, match="for v2-small `anchor_points`, `anchor_indices` is needed"):
        convert(checkpoint(), "v2-small", mano=default_hand(), basis_points=points)
    with pytest.raises(ValueError, match="`dataset` must be one of dexycb, ho3d, oakink; got 'mine'"):
        convert(checkpoint(), "stand-in", mano=default_hand(), dataset="mine")
    given = {"basis_points": points, "anchor_points": np.zeros((32, 3)), "anchor_indices": np.arange(32)}
    with pytest.raises(ValueError, match=r"does not fit v2-small.*looks like stand-in: pass that variant"):
        convert(checkpoint(), "v2-small", mano=default_hand(), **given)
    monkeypatch.setitem(
        presets.RELEASED, "stand-in", lambda dataset, num_views: StandInConfig(views=num_views)
    )
    state = export_state_dict(StandInConfig(views=4), params_of(CONFIG))
    del state["head.move.0.bias"]
    with pytest.raises(ValueError, match="not of `num_views` = 5"):
        convert(state, "stand-in", mano=default_hand(), num_views=5)


def test_a_number_of_views_that_the_data_set_has_not_is_doubted(monkeypatch, caplog):
    state = checkpoint()
    monkeypatch.setitem(
        presets.RELEASED, "stand-in", lambda dataset, num_views: StandInConfig(views=num_views)
    )
    for dataset, views in presets.RELEASED_VIEWS.items():
        for given in (None, views):
            config, _ = convert(state, "stand-in", mano=default_hand(), dataset=dataset, num_views=given)
            assert config == StandInConfig(views=views)
    assert caplog.messages == []
    convert(state, "stand-in", mano=default_hand(), dataset="ho3d", num_views=8)
    assert "the released stand-in of ho3d is made for 5 views, not for 8: is `dataset` right?" in caplog.text


@pytest.mark.parametrize(
    ("variant", "option", "message"),
    [
        (
            "v2-small",
            {"dataset": "ho3d"},
            "released for all data sets at once; leave out --dataset",
        ),
        ("v2-small", {"num_views": 8}, "v2-small takes any number of views; leave out --num-views"),
        ("pe-meshtr", {"num_views": 4}, "pe-meshtr takes any number of views; leave out --num-views"),
    ],
)
def test_what_is_of_no_account_is_refused(tmp_path, variant, option, message):
    with pytest.raises(ValueError, match=message):
        import_release(tmp_path / "none", variant, mano=tmp_path / "none", out=tmp_path / "out", **option)
