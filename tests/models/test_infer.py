"""`infer` against `apply`: the same hands from the views that exist."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.hand.topology import NUM_QUERIES
from poem_jax.models import infer as inference
from poem_jax.models import layers
from poem_jax.models.apply import apply
from poem_jax.models.config import (
    AggregationConfig,
    DecoderOutput,
    Design,
    FeatureConfig,
    RootConfig,
    Similarity,
)
from poem_jax.models.infer import infer, prepare
from poem_jax.models.layers import NormMode
from poem_jax.models.network import assemble

METRES = 2e-5
METRES_IN_FLOAT64 = 1e-9
MASK = np.array([[1, 1, 0, 1], [0, 1, 1, 0], [1, 1, 1, 1]], bool)


def like_release(micro, output=DecoderOutput.OFFSETS):
    """All choices of the released models on a small one; every point a neighbour, so that no tie matters."""
    return replace(
        micro,
        root=RootConfig(num_joints=21, design=Design.RELEASE),
        features=FeatureConfig(stride=4, design=Design.RELEASE),
        basis=replace(micro.basis, num_points=NUM_QUERIES),
        aggregation=AggregationConfig(design=Design.RELEASE),
        decoder=replace(micro.decoder, num_neighbours=NUM_QUERIES, layer=Design.RELEASE, output=output),
    )


def with_heat_maps(micro):
    """Heat maps among the features of views that are all alike."""
    return replace(
        micro,
        root=RootConfig(num_joints=21, stride=4),
        features=FeatureConfig(stride=4, heat_maps=True),
        aggregation=AggregationConfig(similarity=Similarity.EQUAL),
    )


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("release", "release_parametric")]


@pytest.fixture(params=["micro_config", "parametric_config", "heat_maps", *SLOW])
def model(request, make_params, micro_config):
    if request.param.startswith("release"):
        parametric = request.param.endswith("parametric")
        output = DecoderOutput.HAND_PARAMETERS if parametric else DecoderOutput.OFFSETS
        config = like_release(micro_config, output)
    else:
        heat_maps = request.param == "heat_maps"
        config = with_heat_maps(micro_config) if heat_maps else request.getfixturevalue(request.param)
        config = replace(config, decoder=replace(config.decoder, num_neighbours=64))
    return config, make_params(config)


def in_float64(params):
    """Call it where float64 is enabled."""
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, np.float64) if leaf.dtype == np.float32 else leaf, params
    )


def test_infer_finds_what_apply_finds(model, make_scene):
    """In float64, as random hands are metres large and two programs round them differently."""
    config, params = model
    views, cams = make_scene(3, 4)
    cams = cams._replace(view_mask=MASK)
    with jax.enable_x64(True):
        params, views = in_float64(params), views / 255.0
        expected = apply(params, views, cams, config=config)
        found = infer(prepare(params, config), views, cams)
    assert found._fields == expected._fields
    for name in ("vertices_world", "joints_world", "root_world", "layers_world", "translation", "shape"):
        if getattr(expected, name) is not None:
            wanted = getattr(expected, name)
            np.testing.assert_allclose(getattr(found, name), wanted, atol=METRES_IN_FLOAT64, err_msg=name)
    np.testing.assert_array_equal(found.valid, expected.valid)
    np.testing.assert_allclose(found.keypoints_px[MASK], expected.keypoints_px[MASK], atol=1e-3)
    assert not np.any(found.keypoints_px[~MASK])
    assert not np.any(found.heat_maps[~MASK])


def test_bytes_are_seen_as_apply_sees_them(micro_config, make_params, make_scene):
    views, cams = make_scene(3, 4)
    params = make_params(micro_config)
    found, expected = (
        run.keypoints_px
        for run in (
            infer(prepare(params, micro_config), views, cams),
            apply(params, views, cams, config=micro_config),
        )
    )
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_a_moved_heat_map_moves_the_features_at_its_place(micro_config, make_params):
    config = with_heat_maps(micro_config)
    model = assemble(config, make_params(config))
    levels = model.trunk(np.zeros((1, *config.image_hw, 3), np.float32), NormMode())
    _, heat = model.heat_maps(levels, NormMode())
    moved = heat.at[0, 5, 1, 2].multiply(3.0)
    before, after = (model.features(levels, maps, NormMode()) for maps in (heat, moved))
    changed = np.argwhere(np.abs(before - after).max(-1) > 1e-6)
    np.testing.assert_array_equal(changed, [[0, 1, 2]])


def test_only_views_and_samples_that_exist_cost_anything(micro_config, make_params, make_scene, monkeypatch):
    seen, inner = [], inference._run_all

    def counted(function, prepared, parts):
        seen.append(sum(map(len, parts)) if function is inference._look else len(parts))
        return inner(function, prepared, parts)

    monkeypatch.setattr(inference, "_run_all", counted)
    views, cams = make_scene(3, 4)
    prepared = prepare(make_params(micro_config), micro_config)
    mask = MASK & np.array([[True], [False], [True]])
    found = inference.infer_unchecked(prepared, views, cams._replace(view_mask=mask))
    assert seen == [mask.sum(), 2]
    np.testing.assert_array_equal(found.valid, [True, False, True])
    assert not np.any(found.vertices_world[1])
    nothing = inference.infer_unchecked(prepared, views, cams._replace(view_mask=np.zeros((3, 4), bool)))
    assert not nothing.valid.any()
    assert np.isfinite(nothing.vertices_world).all()


@pytest.mark.parametrize("cores", [1, 2, 64])
def test_threads_change_nothing(micro_config, make_params, make_scene, monkeypatch, cores):
    views, cams = make_scene(2, 4)
    prepared = prepare(make_params(micro_config), micro_config)
    expected = infer(prepared, views, cams)
    monkeypatch.setattr(inference, "_cores", lambda: cores)
    np.testing.assert_allclose(infer(prepared, views, cams).layers_world, expected.layers_world, atol=METRES)


def test_accelerators_take_padded_chunks(micro_config, make_params, make_scene, monkeypatch):
    views, cams = make_scene(3, 4)
    cams = cams._replace(view_mask=MASK)
    prepared = prepare(make_params(micro_config), micro_config)
    expected = infer(prepared, views, cams)
    monkeypatch.setattr(inference, "_on_cpu", lambda: False)
    np.testing.assert_allclose(infer(prepared, views, cams).layers_world, expected.layers_world, atol=METRES)


def test_threads_keep_the_settings_of_the_caller(micro_config, make_params, make_scene, monkeypatch):
    monkeypatch.setattr(inference, "_cores", lambda: 2)
    views, cams = make_scene(2, 4)
    with jax.enable_x64(True):
        found = infer(prepare(in_float64(make_params(micro_config)), micro_config), views / 255.0, cams)
    assert found.vertices_world.dtype == np.float64


def test_new_masks_compile_nothing(micro_config, make_params, make_scene, monkeypatch):
    monkeypatch.setattr(inference, "_cores", lambda: 2)
    views, cams = make_scene(3, 4)
    prepared = prepare(make_params(micro_config), micro_config)

    def give(count):
        mask = (np.arange(12) < count).reshape(3, 4)
        inference.infer_unchecked(prepared, views, cams._replace(view_mask=mask))

    for count in (12, 3, 1):  # Pairs, single views on all cores, one view.
        give(count)
    halves = (inference._look, inference._find)
    jitted = [inference._cpu_program(half, alone) for half in halves for alone in (True, False)]
    jitted += [inference._look, inference._find, inference._write, inference._read]
    before = [program._cache_size() for program in jitted]
    for count in range(12):
        give(count)
    assert [program._cache_size() for program in jitted] == before


def test_transformed_kernels_change_nothing(micro_config, make_params, make_scene, monkeypatch):
    """In float64; so few channels are not transformed unless told so, and never on an accelerator."""
    monkeypatch.setattr(layers, "_FILTERED_CHANNELS", range(1, 999))
    monkeypatch.setattr(layers, "_FILTERED_SIZE", 1)
    views, cams = make_scene(2, 3)
    with jax.enable_x64(True):
        params = in_float64(make_params(micro_config))
        prepared = prepare(params, micro_config)
        assert sum(jax.tree.leaves(_reshaped(prepared.params, params))) > 3
        found = infer(prepared, views / 255.0, cams)
        expected = apply(params, views / 255.0, cams, config=micro_config)
        np.testing.assert_allclose(found.vertices_world, expected.vertices_world, atol=1e-8)
    monkeypatch.setattr(inference, "_on_cpu", lambda: False)
    params = make_params(micro_config)
    assert not any(jax.tree.leaves(_reshaped(prepare(params, micro_config).params, params)))


def _reshaped(after, before):
    return jax.tree.map(lambda a, b: a.shape != b.shape, after["trainable"], before["trainable"])


@pytest.mark.parametrize("cores", [1, 2, 3, 16])
def test_views_go_in_pairs_while_there_is_one_for_every_core(cores, monkeypatch):
    monkeypatch.setattr(inference, "_cores", lambda: cores)
    for count in range(40):
        sizes = inference._chunk_sizes(count)
        assert sum(sizes) == count
        assert sizes.count(2) % cores == 0
        assert sizes.count(1) < 2 * cores


def test_single_views_take_their_known_root(micro_config, make_params, make_scene):
    views, cams = make_scene(2, 4)
    cams = cams._replace(view_mask=np.array([[0, 0, 1, 0], [1, 1, 1, 1]], bool))
    prepared = prepare(make_params(micro_config), micro_config)
    with pytest.raises(ValueError, match=r"needs `root_world`.*samples \[0\]"):
        infer(prepared, views, cams)
    root = np.array([[0.01, -0.02, 0.03], [np.nan] * 3], np.float32)
    found = infer(prepared, views, cams, root_world=root)
    assert found.valid.all()
    np.testing.assert_allclose(found.root_world[0], root[0], atol=1e-6)


def test_broken_views_are_left_out_and_flagged(micro_config, make_params, make_scene):
    views, cams = make_scene(2, 4)
    K = cams.K.copy()
    K[0, 1, 0, 0] = np.nan
    prepared = prepare(make_params(micro_config), micro_config)
    found = inference.infer_unchecked(prepared, views, cams._replace(K=K))
    np.testing.assert_array_equal(found.valid, [False, True])
    assert np.isfinite(found.vertices_world).all()


def test_traces_and_other_parameters_are_refused(micro_config, parametric_config, make_params, make_scene):
    views, cams = make_scene(2, 4)
    prepared = prepare(make_params(micro_config), micro_config)
    with pytest.raises(ValueError, match="under jit, grad or vmap use `apply`"):
        jax.jit(lambda v: infer(prepared, v, cams))(views)
    with pytest.raises(ValueError, match="do not belong to `config`"):
        prepare(make_params(micro_config), parametric_config)
