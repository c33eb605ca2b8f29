"""Released state dicts in and out: names and shapes as in the manifests, errors, and which arrays matter."""

import itertools
import json
import logging
import re
from dataclasses import replace

import jax
import numpy as np
import pytest

import poem_jax
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand import mano_file
from poem_jax.hand.model import mirror
from poem_jax.models.config import Config, HRNetConfig, ModelConfig, ResNetConfig
from poem_jax.models.network import describe
from poem_jax.models.presets import preset
from poem_jax.typing import Params
from poem_jax.weights.name_table import write_rows
from poem_jax.weights.release_keys import hand_prefixes, unused_shapes, used_rows
from poem_jax.weights.store import flatten
from poem_jax.weights.torch_import import convert, export_state_dict, import_trunk
from poem_jax.weights.trunk_keys import trunk_rows
from tests.weights.procedural import (
    REFERENCE,
    VARIANTS,
    constants,
    hand_asset,
    manifest,
    needs_reference,
    samples,
    stack_samples,
    state_dict,
    weight,
)

HEAD = "ptEmb_head."
BLOCKS = f"{HEAD}transformer.pt_metro_encoder."
A_LIVE = f"{BLOCKS}1.encoder.attn.self.query.weight"
A_DEAD = f"{BLOCKS}0.pooler.dense.weight"
needs = needs_reference


def zeros(name: str, shape: tuple[int, ...]) -> np.ndarray:
    return np.zeros(shape, np.float32)


def drawn(name: str, shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(list(name.encode())).standard_normal(shape, np.float32)


def imported(state: dict[str, np.ndarray], model: str = "small", **changed: object) -> tuple[Config, Params]:
    return convert(state, VARIANTS[model], **{**constants(), **changed})


@pytest.fixture
def blank() -> dict[str, np.ndarray]:
    """A state dict of the small model that takes no memory."""
    return state_dict("small", zeros)


def assert_equal_trees(ours: Params, other: Params) -> None:
    jax.tree.map(np.testing.assert_array_equal, ours, other)


# The procedural weights of the other tests.


@needs
@pytest.mark.parametrize("model", ["small", "medium_MANO"])
def test_procedural_weights_are_those_of_the_reference(model: str) -> None:
    for check in json.loads((REFERENCE / f"weights_check_{model}.json").read_text()):
        array = weight(check["name"], tuple(check["shape"])).astype(np.float64)
        np.testing.assert_allclose(array.ravel()[:4], check["first4"], rtol=1e-7, err_msg=check["name"])
        np.testing.assert_allclose(array.sum(), check["sum"], rtol=1e-6, atol=1e-4, err_msg=check["name"])
        np.testing.assert_allclose(array.std(), check["std"], rtol=1e-6, err_msg=check["name"])


# Names and shapes.


@needs
@pytest.mark.parametrize("model", VARIANTS)
def test_tables_are_the_manifest(model: str) -> None:
    """What matters, what does not and the hand's buffers make up the whole state dict, each name once."""
    config = preset(f"{VARIANTS[model]}-release")
    live = [entry.source for entry in used_rows(config)]
    hands = hand_prefixes(config)
    weights = [entry for entry in manifest(model) if not entry.hand_field]
    assert sorted(live) == sorted(entry.name for entry in weights if entry.used)
    assert unused_shapes(config) == {entry.name: entry.shape for entry in weights if not entry.used}
    buffers = [entry for entry in manifest(model) if entry.hand_field]
    prefixes = {entry.name.rpartition("th_")[0] for entry in buffers}
    assert hands == {p: any(e.used for e in buffers if e.name.startswith(p)) for p in prefixes}


@needs
@pytest.mark.parametrize("model", VARIANTS)
def test_export_undoes_convert(model: str) -> None:
    """Every array that matters comes back bit by bit, and the rest with its shape and type."""
    state = state_dict(model, drawn)
    config, params = imported(state, model)
    assert config == preset(f"{VARIANTS[model]}-release")
    exported = export_state_dict(config, params)
    assert exported.keys() == state.keys()
    for entry in manifest(model):
        array = exported[entry.name]
        assert (array.shape, array.dtype) == (entry.shape, entry.dtype), entry.name
        if entry.used or entry.hand_field:
            np.testing.assert_array_equal(array, state[entry.name], err_msg=entry.name)
    assert_equal_trees(imported(exported, model)[1], params)


@needs
def test_saved_models_load_as_they_were(tmp_path) -> None:
    config, params = imported(state_dict("small", drawn))
    poem_jax.save(tmp_path / "model", config, params)
    assert_equal_trees(poem_jax.load(tmp_path / "model", expected=config)[1], params)


@needs
def test_constants_go_where_they_belong(blank) -> None:
    given = constants()
    config, params = imported(blank)
    ours = params["constants"]
    np.testing.assert_array_equal(ours["basis_points"], given["basis_points"][0])
    np.testing.assert_array_equal(ours["anchors"]["positions"], given["anchor_points"][0])
    np.testing.assert_array_equal(ours["anchors"]["index"], given["anchor_indices"].reshape(-1))
    for name in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights"):
        np.testing.assert_array_equal(ours["hand"][name], hand_asset()[name])
    joints, root = ours["template_queries"][:21], ours["template_queries"][9]
    np.testing.assert_allclose(root, 0, atol=1e-7)
    assert np.linalg.norm(joints, axis=-1).max() < 2 * config.basis.radius


@needs
def test_what_files_may_hold_beside_the_weights(blank) -> None:
    """Data-parallel training prefixes all names; older libraries wrote position numbers."""
    wrapped = {f"module.{name}": array for name, array in blank.items()}
    wrapped[f"module.{BLOCKS}0.embeddings.position_ids"] = np.arange(512)[None]
    assert_equal_trees(imported(wrapped)[1], imported(blank)[1])


# Errors.


@needs
@pytest.mark.parametrize(("model", "other"), [*itertools.pairwise(VARIANTS), ("medium_MANO", "medium")])
def test_wrong_variant_names_the_right_one(model: str, other: str) -> None:
    message = (
        rf"does not fit {VARIANTS[other]}: \d+ problems.*looks like {VARIANTS[model]}: pass that variant"
    )
    with pytest.raises(ValueError, match=message):
        imported(state_dict(model, zeros), other)


@needs
def test_unknown_variant(blank) -> None:
    with pytest.raises(ValueError, match=r"`variant` must be one of v2-small, .*; got 'v2-huge'"):
        convert(blank, "v2-huge", **constants())


@needs
def test_all_that_does_not_fit_is_reported_together(blank) -> None:
    del blank["img_backbone.conv1.weight"], blank[f"{HEAD}reg_branches.0.0.bias"]
    blank["extra.weight"] = np.zeros(3)
    blank[A_LIVE] = np.zeros((128, 64), np.float32)
    blank[A_DEAD] = np.zeros((1, 128), np.float32)
    blank["uv_out.conv.bias"] = np.zeros(21, np.int64)
    blank["mano_layer.th_betas"] = np.zeros(10)
    with pytest.raises(ValueError, match=r"does not fit v2-small: 7 problems") as error:
        imported(blank)
    for problem in (
        r"img_backbone\.conv1\.weight: missing, expected for trainable\.trunk\.stem\.0\.conv\.kernel",
        r"reg_branches\.0\.0\.bias: missing, expected \(128,\)",
        r"extra\.weight: unknown, got shape \(3,\)",
        r"attn\.self\.query\.weight: expected floats of shape \(128, 128\) .*, got .* of shape \(128, 64\)",
        r"pooler\.dense\.weight: expected shape \(128, 128\), got \(1, 128\)",
        r"uv_out\.conv\.bias: expected floats of shape \(21,\) .*, got int64 of shape \(21,\)",
        r"mano_layer\.th_betas: expected shape \(1, 10\), got \(10,\)",
        r"Is the file cut short, or of another model\?",
    ):
        assert re.search(problem, str(error.value))


@needs
def test_long_lists_of_problems_are_cut(blank) -> None:
    few = dict(itertools.islice(blank.items(), 10))
    with pytest.raises(ValueError, match=r"; and \d{3,} more\."):
        imported(few)


@needs
def test_left_hands_are_refused(blank) -> None:
    left = mirror(mano_file.load(constants()["mano"]))
    with pytest.raises(ValueError, match=r"`mano` must be a right hand.*got a left one"):
        imported(blank, mano=left)


@needs
@pytest.mark.parametrize("name", ["img_backbone.bn1.running_var", A_LIVE, f"{HEAD}mano_layer.th_v_template"])
def test_nan_is_refused_where_it_matters(blank, name: str) -> None:
    blank[name] = np.full_like(blank[name], np.nan)
    with pytest.raises(ValueError, match="weights must be finite; "):
        imported(blank)


WRONG_CONSTANTS = {
    r"`basis_points` must have shape \(4096, 3\).*got \(4095, 3\)": {"basis_points": np.zeros((4095, 3))},
    "`basis_points` must be finite": {"basis_points": np.full((4096, 3), np.nan)},
    r"`anchor_\w+` must have shape \(32,.*got \(31,": {
        "anchor_points": np.zeros((31, 3)),
        "anchor_indices": np.arange(31),
    },
    "`anchor_points` must be finite": {"anchor_points": np.full((32, 3), np.inf)},
    "`anchor_indices` must be whole numbers from 0 to 798": {"anchor_indices": np.arange(768, 800)},
    r"`anchor_indices` must be .*; got \[ ?-1": {"anchor_indices": np.arange(-1, 31)},
}
"""Those that the suite's own check of array types does not refuse first."""


@needs
@pytest.mark.parametrize("message", WRONG_CONSTANTS)
def test_wrong_constants(blank, message: str) -> None:
    flat = {name: array[0] for name, array in constants().items() if name != "mano"}
    flat["anchor_indices"] = flat["anchor_indices"].reshape(-1)
    with pytest.raises(ValueError, match=message):
        imported(blank, **{**flat, **WRONG_CONSTANTS[message]})


@needs
def test_another_hand_than_the_carried_one_is_told(blank, caplog) -> None:
    """The weights' own hand is used; only its faces come from the file."""
    hand = mano_file.load(constants()["mano"])
    other = hand._replace(v_template=hand.v_template + np.float32(1e-3))
    with caplog.at_level(logging.WARNING):
        _, params = imported(blank, mano=other)
    assert "differs from `mano` (v_template by up to 0.001); that of the weights is used" in caplog.text
    np.testing.assert_array_equal(params["constants"]["hand"]["v_template"], hand.v_template)


@needs
def test_mean_pose_of_the_carried_hand_is_ignored_with_a_warning(blank, caplog) -> None:
    _, params = imported(blank)
    blank[f"{HEAD}mano_layer.th_hands_mean"] = np.ones((1, 45), np.float32)
    with caplog.at_level(logging.WARNING):
        _, same = imported(blank)
    assert "mano_layer.th_hands_mean is not zero and is ignored" in caplog.text
    assert_equal_trees(same, params)


def test_only_released_models_are_exported() -> None:
    with pytest.raises(ValueError, match="only the released models can be exported"):
        export_state_dict(preset("tiny"), {})


# ImageNet trunks.


def resnet_state(config: ResNetConfig) -> dict[str, np.ndarray]:
    """Return random arrays under torchvision's names, written down from its source."""
    state: dict[str, np.ndarray] = {}

    def conv_norm(conv: str, norm: str, shape: tuple[int, ...]) -> None:
        state[f"{conv}.weight"] = drawn(f"{conv}.weight", shape)
        for name in ("weight", "bias", "running_mean", "running_var"):
            state[f"{norm}.{name}"] = drawn(f"{norm}.{name}", shape[:1])
        state[f"{norm}.num_batches_tracked"] = np.array(1)

    conv_norm("conv1", "bn1", (64, 3, 7, 7))
    c_in = 64
    for stage, (count, c_out) in enumerate(zip(config.blocks, config.channels, strict=True), 1):
        inner = c_out // 4 if config.bottleneck else c_out
        for name in (f"layer{stage}.{i}" for i in range(count)):
            shapes = [(inner, c_in, 3, 3), (c_out, inner, 3, 3)]
            if config.bottleneck:
                shapes = [(inner, c_in, 1, 1), (inner, inner, 3, 3), (c_out, inner, 1, 1)]
            for k, shape in enumerate(shapes, 1):
                conv_norm(f"{name}.conv{k}", f"{name}.bn{k}", shape)
            if name.endswith(".0") and (stage > 1 or config.bottleneck):
                conv_norm(f"{name}.downsample.0", f"{name}.downsample.1", (c_out, c_in, 1, 1))
            c_in = c_out
    features = config.channels[-1]
    return state | {"fc.weight": zeros("", (1000, features)), "fc.bias": zeros("", (1000,))}


def hrnet_state(config: HRNetConfig) -> dict[str, np.ndarray]:
    """Return random arrays under the names of the manifest, the classifier of ImageNet included."""
    prefix = "img_backbone."
    entries = [e for e in manifest("small") if e.name.startswith(prefix)]
    return {e.name.removeprefix(prefix): drawn(e.name, e.shape).astype(e.dtype) for e in entries}


TRUNKS = {
    "resnet18": (ResNetConfig.resnet18(), resnet_state, 122),
    "resnet34": (ResNetConfig.resnet34(), resnet_state, 218),
    "resnet50": (ResNetConfig.resnet50(), resnet_state, 320),
    "hrnet": (HRNetConfig(), hrnet_state, None),
}
"""Trunks, where their arrays come from, and how many torchvision's state dicts hold."""


def empty_params(config: ModelConfig) -> Params:
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), describe(config))


@pytest.fixture(params=[pytest.param(name, marks=[needs] if name == "hrnet" else []) for name in TRUNKS])
def trunk(request):
    """A config and a state dict for its trunk."""
    backbone, make_state, count = TRUNKS[request.param]
    state = make_state(backbone)
    assert count in (None, len(state))
    return replace(preset("v2-small"), backbone=backbone), state


def test_trunks_take_all_arrays_and_leave_the_rest(trunk) -> None:
    config, state = trunk
    params = empty_params(config)
    filled = import_trunk({f"module.{name}": array for name, array in state.items()}, config, params)
    back = write_rows(list(trunk_rows(config.backbone)), flatten(filled))
    for name, array in back.items():
        np.testing.assert_array_equal(array, state[name], err_msg=name)
    ignored = ("incre_modules.", "downsamp_modules.", "final_layer.", "classifier.", "fc.")
    left = {n for n in state if not n.startswith(ignored) and not n.endswith("num_batches_tracked")}
    assert left == set(back)
    for name, leaf in flatten(filled).items():
        assert leaf.any() == (".trunk." in name), name


@pytest.mark.parametrize("name", ["pe-meshtr-release", "ftl-meshtr-release"])
def test_a_trunk_that_is_cut_short_takes_its_stages_of_a_whole_one(name: str) -> None:
    config, state = preset(name), resnet_state(ResNetConfig.resnet34())
    filled = flatten(import_trunk(state, config, empty_params(config)))
    for source, array in write_rows(list(trunk_rows(config.backbone)), filled).items():
        np.testing.assert_array_equal(array, state[source], err_msg=source)
    state["layer2.9.conv1.weight"] = np.zeros(3)
    with pytest.raises(ValueError, match=r"1 problems: layer2\.9\.conv1\.weight: unknown"):
        import_trunk(state, config, empty_params(config))


def test_trunks_that_do_not_fit(trunk) -> None:
    config, state = trunk
    name = type(config.backbone).__name__.removesuffix("Config")
    del state["conv1.weight"]
    state["bn1.bias"] = state["bn1.bias"][:3]
    state["head.weight"] = np.zeros(3)
    message = (
        rf"not a {name} of this size: 3 problems: conv1\.weight: missing.*bn1\.bias: .*head\.weight: unknown"
    )
    with pytest.raises(ValueError, match=message):
        import_trunk(state, config, empty_params(config))


def test_trunks_must_be_finite(trunk) -> None:
    config, state = trunk
    state["bn1.bias"] = np.full_like(state["bn1.bias"], np.nan)
    with pytest.raises(ValueError, match="weights must be finite"):
        import_trunk(state, config, empty_params(config))


# Which arrays matter.

WITHOUT_EFFECT = {
    r"\.self\.key\.bias$": "adds the same to all logits of a query",
    r"\.fc_gamma\.2\.bias$": "adds the same to all logits of a query and channel",
    rf"^{HEAD}mano_layer\.th_shapedirs$": "the template has zero shape",
    rf"^{HEAD}mano_layer\.th_posedirs$": "the template has zero pose",
    r"\.th_hands_mean$": "not zero in no released model; ignored with a warning",
}
"""Arrays that the manifests call used, and why the output does not change with them."""
PARAMETRIC_ONLY = (
    f"{BLOCKS}2.flat_verts.weight",
    f"{BLOCKS}2.flat_verts.bias",
    f"{BLOCKS}2.mano_linear.weight",
    f"{BLOCKS}2.mano_linear.bias",
    f"{BLOCKS}2.encoder.output.LayerNorm.weight",
    *(
        f"{BLOCKS}2.mano_layer.th_{field}"
        for field in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "hands_mean")
    ),
    f"{HEAD}mano_layer.th_v_template",
)
NUM_SAMPLED = 32


def sampled_names() -> list[str]:
    """Draw a name each of some kinds (names without numbers) of the small model, and of all special kinds."""
    rng = np.random.default_rng(0)
    kinds: dict[str, list[str]] = {}
    for entry in manifest("small"):
        if entry.used:
            kinds.setdefault(re.sub(r"\d+", "#", entry.name), []).append(entry.name)
    one_each = [str(rng.choice(names)) for names in kinds.values()]
    special = [n for n in one_each if ".th_" in n or any(re.search(p, n) for p in WITHOUT_EFFECT)]
    ordinary = sorted(set(one_each) - set(special))
    return [*special, *map(str, rng.choice(ordinary, NUM_SAMPLED, replace=False))]


def changes(model: str, names: list[str]) -> dict[str, float]:
    """Return how far the final points move (median, metres) when one source array is disturbed.

    On views of a quarter of the size: whether an array is read does not hang on the pixels.
    """
    state = state_dict(model)
    batch = stack_samples([list(samples("A"))[1]])
    views = batch.views[:, :, ::4, ::4]
    K, T, view_mask = batch.cameras
    cams = Cameras(K * np.array([[0.25], [0.25], [1]], np.float32), T, view_mask)
    rng = np.random.default_rng(1)

    def points(state: dict[str, np.ndarray]) -> np.ndarray:
        config, params = imported(state, model)
        config = replace(config, image_hw=views.shape[2:4])
        return np.asarray(poem_jax.apply(params, views, cams, config=config).layers_world[:, -1])

    before, moved = points(state), {}
    for name in names:
        disturbed = (state[name] + rng.uniform(0.02, 0.05, state[name].shape)).astype(np.float32)
        gap = np.linalg.norm(points({**state, name: disturbed}) - before, axis=-1)
        moved[name] = float(np.median(gap))
    return moved


@needs
@pytest.mark.parity
@pytest.mark.parametrize("model", ["small", "medium_MANO"])
def test_used_arrays_move_the_points_and_those_without_effect_do_not(model: str) -> None:
    names = sampled_names() if model == "small" else list(PARAMETRIC_ONLY)
    still = {name for name in names if any(re.search(p, name) for p in WITHOUT_EFFECT)}
    assert still
    moved = changes(model, names)
    assert {name: gap for name, gap in moved.items() if name in still and gap > 1e-6} == {}
    assert {name: gap for name, gap in moved.items() if name not in still and gap < 1e-5} == {}


@needs
@pytest.mark.parametrize("model", ["small", "medium_MANO"])
def test_unused_arrays_leave_the_parameters_as_they_are(model: str) -> None:
    """An output is a function of the parameters, so NaN in all unused arrays changes none."""
    state = state_dict(model, drawn)
    unused = {e.name: e for e in manifest(model) if not e.used}
    broken = {
        name: np.full(e.shape, np.nan if e.dtype.kind == "f" else -1, e.dtype) for name, e in unused.items()
    }
    assert_equal_trees(imported({**state, **broken}, model)[1], imported(state, model)[1])
