"""What runs every system, run with one that has no root, no key points and no heat maps."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.hand.topology import NUM_QUERIES, split_queries
from poem_jax.models import infer as inference
from poem_jax.models import systems
from poem_jax.models.apply import _predict, apply, check_inputs, init
from poem_jax.models.config import ModelConfig
from poem_jax.models.infer import infer, infer_unchecked, prepare
from poem_jax.models.network import describe, forward
from poem_jax.models.presets import PRESETS
from tests import stand_in
from tests.stand_in import DRAWN_POINTS, GRID_POINTS, StandInConfig

PLAIN, DRAWING = StandInConfig(), StandInConfig(draws=True)
MASK = np.array([[1, 1, 0, 1], [0, 1, 1, 0], [1, 1, 1, 1]], bool)
NOT_THERE = (
    "root_world",
    "keypoints_px",
    "heat_maps",
    "reference_joints_world",
    "reference_joints_mask",
    "pose",
    "shape",
    "translation",
)


@pytest.fixture(autouse=True)
def system(monkeypatch):
    stand_in.register(monkeypatch)


def params_of(config: ModelConfig) -> dict:
    return init(config, key=jax.random.key(1))


def same(a, b, atol=1e-6) -> None:
    np.testing.assert_allclose(a.layers_world, b.layers_world, atol=atol)
    np.testing.assert_array_equal(a.valid, b.valid)


def test_what_a_system_does_not_have_is_none(make_scene):
    views, cams = make_scene(3, 4)
    params = params_of(PLAIN)
    for found in (apply(params, views, cams, config=PLAIN), infer(prepare(params, PLAIN), views, cams)):
        assert [getattr(found, name) for name in NOT_THERE] == [None] * len(NOT_THERE)
        assert found.layers_world.shape == (3, 2, NUM_QUERIES, 3)
        vertices, joints = split_queries(found.layers_world[:, -1], PLAIN.query_order)
        np.testing.assert_array_equal(found.vertices_world, vertices)
        np.testing.assert_array_equal(found.joints_world, joints)
        assert found.valid.all()


def test_what_a_system_does_not_take_is_refused(make_scene):
    views, cams = make_scene(2, 4)
    params, prepared = params_of(PLAIN), prepare(params_of(PLAIN), PLAIN)
    indices = np.zeros((2, DRAWN_POINTS), np.int32)
    for given, what in (
        ({"root_world": np.zeros((2, 3), np.float32)}, "`root_world` must be None for this StandInConfig"),
        ({"ball_index": indices}, "`ball_index` must be None for this StandInConfig"),
        ({"key": jax.random.key(0)}, "`key` must be None for this StandInConfig"),
    ):
        for run in (
            lambda **g: apply(params, views, cams, config=PLAIN, **g),
            lambda **g: infer(prepared, views, cams, **g),
        ):
            with pytest.raises(ValueError, match=what):
                run(**given)


def test_poem_v2_draws_nothing(micro_config, make_params, make_scene):
    views, cams = make_scene(2, 4)
    with pytest.raises(ValueError, match="`key` must be None for this Config, which draws no points"):
        apply(make_params(micro_config), views, cams, config=micro_config, key=jax.random.key(0))


@pytest.mark.parametrize("cores", [1, 2, 64])
@pytest.mark.parametrize(
    "config", [PLAIN, DRAWING, StandInConfig(coupled=True)], ids=["plain", "draws", "coupled"]
)
def test_infer_finds_what_apply_finds(config, cores, make_scene, monkeypatch):
    monkeypatch.setattr(inference, "_cores", lambda: cores)
    views, cams = make_scene(3, 4)
    cams = cams._replace(view_mask=MASK)
    params = params_of(config)
    same(infer(prepare(params, config), views, cams), apply(params, views, cams, config=config))


def test_accelerators_take_the_draw_too(make_scene, monkeypatch):
    views, cams = make_scene(3, 4)
    params = params_of(DRAWING)
    indices = np.arange(3 * DRAWN_POINTS, dtype=np.int64).reshape(3, DRAWN_POINTS)
    expected = infer(prepare(params, DRAWING), views, cams, ball_index=indices)
    monkeypatch.setattr(inference, "_on_cpu", lambda: False)
    same(infer(prepare(params, DRAWING), views, cams, ball_index=indices), expected)


def test_samples_that_depend_on_each_other_stay_together(make_scene):
    views, cams = make_scene(3, 4)
    views = views // np.array([1, 2, 4], np.uint8)[:, None, None, None, None]
    config = StandInConfig(coupled=True)
    params = params_of(config)
    whole = apply(params, views, cams, config=config)
    alone = apply(params, views[1:2], jax.tree.map(lambda x: x[1:2], cams), config=config)
    assert np.abs(whole.vertices_world[1] - alone.vertices_world[0]).max() > 1e-3
    same(infer(prepare(params, config), views, cams), whole)


def test_one_key_one_draw(make_scene):
    views, cams = make_scene(3, 4)
    params = params_of(DRAWING)
    first, again, other = (
        apply(params, views, cams, config=DRAWING, **given)
        for given in ({}, {"key": jax.random.key(0)}, {"key": jax.random.key(5)})
    )
    np.testing.assert_array_equal(first.layers_world, again.layers_world)
    assert np.abs(np.asarray(first.layers_world - other.layers_world)).max() > 1e-3
    order = np.asarray(jax.random.permutation(jax.random.key(0), 4 * GRID_POINTS))[:DRAWN_POINTS]
    for indices in (np.tile(order, (3, 1)), jnp.tile(order.astype(np.int16), (3, 1))):
        same(apply(params, views, cams, config=DRAWING, ball_index=indices), first)
        same(infer(prepare(params, DRAWING), views, cams, ball_index=indices), first)
    jitted = jax.jit(lambda index: apply(params, views, cams, config=DRAWING, ball_index=index))
    same(jitted(np.tile(order, (3, 1))), first)


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"ball_index": np.zeros((2, 3), np.int32)}, r"shape \(batch, point\) = \(2, 4\); got \(2, 3\)"),
        ({"ball_index": np.zeros((2, 4), np.float32)}, "an array of whole numbers; got float32"),
        ({"ball_index": [[0] * 4] * 2}, "an array of whole numbers; got list"),
        (
            {"ball_index": np.full((2, 4), -2)},
            "24 grid points of 4 views, 0 to 23, with -1 .* -2 to",
        ),
        ({"ball_index": np.full((2, 4), 24)}, "0 to 23, .*; got 24 to 24"),
        ({"ball_index": np.array([[0, -1, 5, -1], [-1] * 4])}, r"in samples \[1\] all are -1"),
        (
            {"ball_index": np.array([[0, 5, 7, 11], [0, 6, 17, 18]])},
            r"samples \[0, 1\] name points of the masked views \[1, 3\]",
        ),
        ({"key": 3}, "`key` must be one key of `jax.random`; got 3"),
        ({"key": jax.random.split(jax.random.key(0))}, "`key` must be one key"),
    ],
)
def test_a_wrong_draw_is_one_line(given, what, make_scene):
    views, cams = make_scene(2, 4)
    cams = cams._replace(view_mask=np.array([[1, 0, 1, 1], [1, 1, 1, 0]], bool))
    with pytest.raises(ValueError, match=what):
        check_inputs(views, cams, None, DRAWING, **given)


def test_a_draw_of_a_ball_that_held_fewer_points_is_taken(make_scene):
    views, cams = make_scene(2, 4)
    cams = cams._replace(view_mask=np.array([[1, 0, 1, 1], [1, 1, 1, 0]], bool))
    check_inputs(views, cams, None, DRAWING, ball_index=np.array([[0, 23, -1, -1], [6, -1, 17, -1]]))


def test_a_number_of_views_that_the_layers_are_not_made_for(make_scene):
    config = StandInConfig(views=4)
    params = params_of(config)
    for count in (3, 5):
        views, cams = make_scene(2, count)
        with pytest.raises(ValueError, match=f"`views` must have 4 views, .* StandInConfig .* got {count}"):
            apply(params, views, cams, config=config)
        with pytest.raises(ValueError, match=f"got {count}"):
            infer(prepare(params, config), views, cams)
        with pytest.raises(ValueError, match=f"`views` must have 4 views, .* got {count}"):
            infer_unchecked(prepare(params, config), views, cams)
        with pytest.raises(ValueError, match=f"`views` must have 4 views, .* got {count}"):
            forward(params, views, cams, config=config, train=True)
    views, cams = make_scene(3, 4)
    assert apply(params, views, cams._replace(view_mask=MASK), config=config).valid.all()


def test_who_does_not_triangulate_needs_one_view(make_scene):
    views, cams = make_scene(2, 4)
    mask = np.array([[0, 0, 1, 0], [1, 1, 1, 1]], bool)
    params = params_of(PLAIN)
    one = apply(params, views, cams._replace(view_mask=mask), config=PLAIN)
    assert one.valid.all()
    at_one_place = cams._replace(T_cam_from_world=np.tile(cams.T_cam_from_world[:, :1], (1, 4, 1, 1)))
    assert apply(params, views, at_one_place, config=PLAIN).valid.all()
    with pytest.raises(ValueError, match=r"at least one valid view.*samples \[0\]"):
        apply(params, views, cams._replace(view_mask=mask & [[False], [True]]), config=PLAIN)


def test_an_empty_ball_is_one_line(make_scene):
    views, cams = make_scene(2, 4)
    config = replace(DRAWING, ball_is_empty=True)
    with pytest.raises(ValueError, match=r"lie in the ball about the hand; in samples \[0, 1\] none does"):
        apply(params_of(config), views, cams, config=config)
    traced = jax.jit(lambda v: apply(params_of(config), v, cams, config=config))(views)
    assert not traced.valid.any()


def test_masks_and_draws_compile_nothing_new(make_scene):
    views, cams = make_scene(3, 4)
    params = params_of(DRAWING)
    apply(params, views, cams, config=DRAWING)
    programs = _predict._cache_size()
    apply(params, views, cams._replace(view_mask=MASK), config=DRAWING, key=jax.random.key(9))
    assert _predict._cache_size() == programs


def test_a_config_of_no_system_is_named(monkeypatch):
    monkeypatch.delitem(systems.MODULES, StandInConfig)
    with pytest.raises(ValueError, match=r"must be of one of the classes .*Config.*; got StandInConfig"):
        init(PLAIN, key=jax.random.key(0))


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_of_a_system_and_says_what_it_takes(name):
    config = PRESETS[name]
    assert type(config) in systems.MODULES
    assert isinstance(config, ModelConfig)
    least, most = config.view_range
    assert 1 <= least <= (most or least)
    assert not config.takes_root or config.triangulates
    shapes = describe(config)
    assert shapes["constants"]["hand"]["v_template"].shape == (778, 3)
    assert config.query_order is not None
