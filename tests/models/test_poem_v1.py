"""POEM v1 and its ablations on a micro configuration: laws of the whole, in float64, where no neighbour and
no basis point hangs on rounding."""

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle, transform_points
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES, ROOT_JOINT, split_queries
from poem_jax.models import apply as apply_checks
from poem_jax.models.apply import check_inputs
from poem_jax.models.ball_query import draw_ball
from poem_jax.models.config import Design, FrozenNorms, ResNetConfig, RootConfig, Stem
from poem_jax.models.detr_config import DetrConfig
from poem_jax.models.frustum import frustum_grid
from poem_jax.models.frustum_config import Cuboid, DepthSteps, FrustumConfig
from poem_jax.models.layers import NormMode
from poem_jax.models.network import forward, leaves_with_names, split
from poem_jax.models.poem_v1 import PoemV1
from poem_jax.models.poem_v1_config import (
    BallConfig,
    BasisFeatures,
    OneStageConfig,
    PoemV1Config,
    PointDecoderConfig,
    QueryEmbedding,
    TokenDecoderConfig,
)
from poem_jax.models.poem_v1_release import CodedMaps, UnnormalisedAggregation, projected_anyhow
from poem_jax.models.poem_v1_start import LinearMesh, Start, space_of
from poem_jax.models.world_frame import enter_working_frame

METRES = 1e-8
CUBOID = Cuboid((-0.5, -0.5, 0.2), (0.5, 0.5, 1.0))
TRUNK = ResNetConfig((1, 1), (8, 16), bottleneck=False, stem=Stem.SPACE_TO_DEPTH, stem_channels=8)
V1 = PoemV1Config(
    image_hw=(32, 32),
    width=24,
    backbone=TRUNK,
    basis=BallConfig(48, 0.1, FrustumConfig(4, 0.4, 0.8)),
    decoder=PointDecoderConfig(num_layers=2, num_neighbours=8, num_heads=2, ffn_expansion=1),
)
RELEASE = replace(
    V1,
    design=Design.RELEASE,
    backbone=replace(TRUNK, frozen_norms=FrozenNorms.STAGE_STARTS),
    first_stage=RootConfig(NUM_JOINTS, design=Design.RELEASE),
    space=CUBOID,
    basis=BallConfig(48, 0.2, FrustumConfig(4, 0.4, 0.8, DepthSteps.LINEAR, 0.0)),
)
CONFIGS = {
    "v1": V1,
    "v1-1stage": replace(V1, first_stage=OneStageConfig((0.0, 0.0, 0.6)), space=CUBOID),
    "v1-wo-proj": replace(V1, basis_features=BasisFeatures.OWN_CAMERA),
    "v1-wo-pt": replace(
        V1, decoder=TokenDecoderConfig(DetrConfig(num_layers=2, num_heads=2, ffn_width=8), CUBOID)
    ),
    "release": RELEASE,
    "release-wo-proj": replace(
        RELEASE,
        basis_features=BasisFeatures.OWN_CAMERA,
        query_embedding=QueryEmbedding.POINT_CODES,
    ),
}
DEEP = BallConfig(48, 0.1, FrustumConfig(6, 0.4, 0.8))
DRAWING = [name for name, config in CONFIGS.items() if config.grid_draw is not None]


class Model(NamedTuple):
    """A model's structure, its random weights, and its one compiled program."""

    graph: Any
    state: Any
    run: Any


@functools.cache
def model_of(config: PoemV1Config) -> Model:
    """Weights are random, so that zero initial ones hide nothing."""
    rng = np.random.default_rng(0)
    module = PoemV1(config, default_hand(), rngs=nnx.Rngs(0))

    def draw(path: tuple, leaf: np.ndarray) -> np.ndarray:
        if path[0] == "hand" or path[-1] == "template" or leaf.dtype.kind != "f":
            return leaf
        name = path[-1]
        if name in ("scale", "variance"):
            return rng.uniform(0.5, 1.5, leaf.shape)
        if name in ("points", "table"):
            return rng.uniform(0.4, 0.6, leaf.shape)
        fan_in = np.prod(leaf.shape[-4:-1]) if name == "kernel" else 16
        return rng.normal(size=leaf.shape) / np.sqrt(fan_in)

    graph, state = nnx.split(module)
    flat = nnx.to_flat_state(state)
    drawn = [(path, v.replace(jnp.asarray(_as64(draw(path, np.asarray(v.get_value())))))) for path, v in flat]
    state = nnx.from_flat_state(drawn)

    @jax.jit
    def run(state, views, frame, ball_index, key):
        module = nnx.merge(graph, state)
        return module.find_hands(
            module.look(views, NormMode()), frame, NormMode(), ball_index=ball_index, key=key
        )

    return Model(graph, state, run)


def _as64(array: np.ndarray) -> np.ndarray:
    return array.astype(np.float64) if array.dtype.kind == "f" else array


def predict(config, views, cams, *, ball_index=None, key=None, root=None):
    with jax.enable_x64(True):
        model = model_of(config)
        frame = enter_working_frame(views, cams, root, np.float64)
        key = jax.random.key(0) if key is None else key
        found = model.run(model.state, np.asarray(views), frame, ball_index, key)
        return jax.tree.map(np.asarray, found)


@pytest.fixture(params=CONFIGS)
def config(request):
    return CONFIGS[request.param]


@pytest.fixture
def scene(make_scene):
    """Two samples of four views; the second view of the second sample is masked."""
    views, cams = make_scene(2, 4)
    return views, _masked(cams, [[1, 1, 1, 1], [1, 0, 1, 1]])


def _masked(cams, mask):
    return Cameras(cams.K.astype(np.float64), cams.T_cam_from_world.astype(np.float64), np.array(mask, bool))


def _moved_views(views, cams, order):
    """Put view order[i] of every sample at place i."""
    return views[:, order], Cameras(*(leaf[:, order] for leaf in cams))


def test_prediction_has_what_the_system_has(config, scene):
    found = predict(config, *scene)
    layers = found.layers_world
    assert layers.shape == (2, 2, NUM_QUERIES, 3)
    assert found.valid.all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    vertices, joints = split_queries(layers[:, -1], config.query_order)
    np.testing.assert_array_equal(found.vertices_world, vertices)
    np.testing.assert_array_equal(found.joints_world, joints)
    has_root = isinstance(config.first_stage, RootConfig)
    for leaf in (found.root_world, found.keypoints_px, found.heat_maps, found.reference_joints_world):
        assert (leaf is not None) == has_root
    if has_root:
        assert found.keypoints_px.shape == (2, 4, NUM_JOINTS, 2)
        np.testing.assert_allclose(found.root_world, found.reference_joints_world[:, ROOT_JOINT], atol=1e-9)


def test_images_and_layers_matter(config, scene, make_scene):
    """Guards the tests below against outputs that depend on nothing."""
    views, cams = scene
    found, other = predict(config, views, cams), predict(config, make_scene(2, 4, seed=1)[0], cams)
    assert np.abs(found.layers_world - other.layers_world).max() > 1e-4
    assert np.abs(found.layers_world[:, 0] - found.layers_world[:, 1]).max() > 1e-5


def test_content_and_place_of_masked_views_change_nothing(config, make_scene):
    views, cams = make_scene(2, 4)
    expected = predict(config, views, _masked(cams, [[1, 1, 1, 0]] * 2))
    garbage = views.copy()
    garbage[:, 3] = 77
    K, T = cams.K.copy(), cams.T_cam_from_world.copy()
    K[:, 3], T[:, 3] = np.nan, 0
    spoilt = _masked(Cameras(K, T), [[1, 1, 1, 0]] * 2)
    order = [3, 0, 1, 2]
    for scene in ((garbage, spoilt), _moved_views(garbage, spoilt, order)):
        found = predict(config, *scene)
        np.testing.assert_allclose(found.layers_world, expected.layers_world, atol=METRES)


def test_prediction_moves_with_the_world(config, scene):
    views, cams = scene
    T_new_from_old = rigid(rotation_from_axis_angle(np.array([0.3, -2.0, 1.0])), np.array([0.4, -0.2, 1.0]))
    moved = cams._replace(T_cam_from_world=cams.T_cam_from_world @ np.linalg.inv(T_new_from_old))
    expected = transform_points(T_new_from_old, predict(config, views, cams).layers_world)
    np.testing.assert_allclose(predict(config, views, moved).layers_world, expected, atol=METRES)


def test_other_samples_do_not_matter(config, scene, make_scene):
    views, cams = scene
    other_views, other_cams = make_scene(2, 4, seed=1)
    mixed = np.stack([views[0], other_views[1]])
    mixed_cams = Cameras(*(np.stack([a[0], b[1]]) for a, b in zip(cams, other_cams, strict=True)))
    expected, found = predict(config, views, cams), predict(config, mixed, mixed_cams)
    np.testing.assert_allclose(found.layers_world[0], expected.layers_world[0], atol=METRES)
    assert np.abs(found.layers_world[1] - expected.layers_world[1]).max() > 1e-4


def _ball_index(config, views, seed=0):
    """Any points of the grids, the same in all samples."""
    draw = config.grid_draw
    rng = np.random.default_rng(seed)
    return np.stack([rng.permutation(views * draw.points_per_view)[: draw.num_points]] * 2).astype(np.int32)


@pytest.mark.parametrize("name", ["v1", "v1-wo-proj", "v1-wo-pt", "release"])
def test_other_views_are_a_set_but_for_the_release(name, make_scene):
    """With the same basis points, which are numbered by view: which are drawn depends on the views' order.
    The release tells features the view's number; the paper's models know no numbers."""
    config = CONFIGS[name]
    views, cams = make_scene(2, 4)
    cams = _masked(cams, np.ones((2, 4)))
    order = [0, 2, 3, 1]
    index = turned_index = None
    if config.grid_draw is not None:
        index, size = _ball_index(config, 4), config.grid_draw.points_per_view
        turned_index = (np.argsort(order)[index // size] * size + index % size).astype(np.int32)
    found = predict(config, views, cams, ball_index=index).layers_world
    turned = predict(config, *_moved_views(views, cams, order), ball_index=turned_index).layers_world
    if config.design is Design.PAPER:
        np.testing.assert_allclose(turned, found, atol=METRES)
    else:
        assert np.abs(turned - found).max() > 1e-4


def test_no_basis_point_is_read_twice_where_the_ball_holds_few(make_scene):
    """20 points fill 48 places: neither their order nor where the copies stand changes anything."""
    views, cams = make_scene(2, 4)
    few = np.where(np.arange(48) < 20, _ball_index(V1, 4), -1).astype(np.int32)
    mixed = few[:, np.random.default_rng(1).permutation(48)]
    expected, found = (predict(V1, views, cams, ball_index=index).layers_world for index in (few, mixed))
    np.testing.assert_allclose(found, expected, atol=METRES)
    other = np.where(np.arange(48) == 3, few[:, :1], few)
    assert np.abs(predict(V1, views, cams, ball_index=other).layers_world - expected).max() > 1e-5


def test_a_draw_of_few_points_can_be_given_back(make_scene):
    """As indices with -1."""
    views, cams = make_scene(2, 4)
    cams = _masked(cams, [[1, 0, 0, 1]] * 2)
    drawn = predict(V1, views, cams)
    with jax.enable_x64(True):
        frame = enter_working_frame(views, cams, None, np.float64)
        root = transform_points(cams.T_cam_from_world[:, 0], drawn.root_world[:, None])[:, 0]
        grid = frustum_grid(V1.basis.frustum, Cameras(*map(jnp.asarray, frame.cams)), V1.map_hw, V1.image_hw)
        ball = draw_ball(V1.basis, grid, jnp.asarray(root), jnp.asarray(cams.view_mask), jax.random.key(0))
    index = np.asarray(ball.index, np.int32)
    assert (index.min(1) == -1).all()
    check_inputs(views, cams, None, V1, ball_index=index)
    found = predict(V1, views, cams, ball_index=index)
    assert found.valid.all()
    np.testing.assert_allclose(found.layers_world, drawn.layers_world, atol=METRES)


def test_one_stage_stays_in_its_cuboid():
    """`test_poem_v1_equations.py` has the decoder move points by its space."""
    space = space_of(CONFIGS["v1-1stage"], None)
    shares = jnp.array([[[0.1, 0.5, 0.9]]] * 3)
    points = space.leave(space.move(shares, jnp.array([[[-9.0] * 3], [[0.0] * 3], [[9.0] * 3]])))
    np.testing.assert_allclose(points[1, 0], [-0.4, 0.0, 0.92], atol=1e-5)
    assert (points > jnp.array(CUBOID.low)).all()
    assert (points < jnp.array(CUBOID.high)).all()
    assert (jnp.abs(points[2] - points[0]) > 0.7).all()


@pytest.mark.parametrize("name", DRAWING)
def test_the_key_draws_the_basis_points(name, scene):
    zero, one = (predict(CONFIGS[name], *scene, key=jax.random.key(i)).layers_world for i in (0, 1))
    assert np.abs(one - zero).max() > 1e-6


def test_without_a_key_it_is_key_0(make_scene):
    module = PoemV1(V1, default_hand(), rngs=nnx.Rngs(0))
    cams = Cameras(*map(jnp.asarray, make_scene(1, 4)[1]))
    grid = frustum_grid(V1.basis.frustum, cams, V1.map_hw, V1.image_hw)
    centre = jnp.mean(grid, (1, 2, 3, 4))
    start = Start(jnp.zeros((1, NUM_QUERIES, 3)), centre, None, None, None, jnp.ones(1, bool))
    default, zero, one = (
        module._basis(None, grid, start, cams, key).index
        for key in (None, jax.random.key(0), jax.random.key(1))
    )
    np.testing.assert_array_equal(default, zero)
    assert (np.asarray(default) != np.asarray(one)).any()


@pytest.mark.parametrize("name", ["v1", "release"])
def test_a_ball_without_points_is_not_valid_and_finite(name, scene):
    """The hand is ten times as far as the grids reach."""
    views, cams = scene
    T = cams.T_cam_from_world.copy()
    T[..., :3, 3] *= 10
    found = predict(CONFIGS[name], views, cams._replace(T_cam_from_world=T))
    assert not found.valid.any()
    assert np.isfinite(found.layers_world).all()
    assert (np.abs(found.reference_joints_world).max((1, 2)) > 0).all()


_EMPTY = r"lie in the ball about {}; in samples \[1\] none does"


@pytest.mark.parametrize(
    ("name", "unsolved", "root", "message"),
    [
        (
            "release",
            [4, 8],
            None,
            r"all 21 joints .* in samples \[1\] the rays to joints \[4, 8\] meet behind",
        ),
        ("release", [], None, _EMPTY.format("the triangulated hand")),
        ("v1", [4, 8], None, _EMPTY.format("the hand's root joint")),
        ("v1", [], [[0, 0, 0]] * 2, _EMPTY.format("the hand's root joint")),
        (
            "v1-1stage",
            [],
            None,
            _EMPTY.format(r"`first_stage.origin` = \(0.0, 0.0, 0.6\), metres before the pri.*"),
        ),
    ],
)
def test_the_cause_of_no_answer_is_named(name, unsolved, root, message, scene, monkeypatch):
    """Of a sample whose rays to the root meet; where the root is given, there may be one ray."""
    monkeypatch.setattr(apply_checks, "_rays_meet", lambda cams, uv_px: np.ones(2, bool))
    views, cams = scene
    root = None if root is None else np.array(root, np.float32)
    if root is not None:
        cams = _masked(cams, [[1, 1, 1, 1], [1, 0, 0, 0]])
    uv_px, _ = project(cams.K, cams.T_cam_from_world, np.zeros((1, 1, NUM_JOINTS, 3)))
    mask = np.ones((2, NUM_JOINTS), bool)
    mask[1, unsolved] = False
    found = Prediction(None, None, None, uv_px, None, np.array([True, False]), reference_joints_mask=mask)
    with pytest.raises(ValueError, match=message):
        apply_checks.check_solved(found, enter_working_frame(views, cams, root, np.float32), CONFIGS[name])


def test_known_root_is_used_where_the_system_has_one(make_scene):
    views, cams = make_scene(2, 4)
    cams = _masked(cams, [[1, 0, 0, 0], [1, 1, 1, 1]])
    root = np.array([[0.01, -0.02, 0.03], [np.nan] * 3])
    found = predict(V1, views, cams, root=root)
    assert V1.takes_root
    assert found.valid[1]
    np.testing.assert_allclose(found.root_world[0], root[0], atol=1e-6)
    assert [name for name, config in CONFIGS.items() if not config.takes_root] == [
        "v1-1stage",
        "release",
        "release-wo-proj",
    ]


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name == "v1" else pytest.mark.slow) for name in CONFIGS],
)
def test_one_program_for_1_to_8_views(name, make_scene):
    views, cams = make_scene(1, 8)
    run = model_of(CONFIGS[name]).run
    programs = run._cache_size()
    for count in range(1, 9):
        predict(CONFIGS[name], views, _masked(cams, [[i < count for i in range(8)]]))
    assert run._cache_size() == programs + 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["v1", "release"])
def test_training_has_finite_gradients_everywhere(name, make_scene):
    """But in the release's layer that moves the ball, which no gradient reaches, and in biases that the
    softmax takes away."""
    config = CONFIGS[name]
    views, cams = make_scene(2, 2)
    with jax.enable_x64(True):
        model = model_of(config)
        params = split(nnx.merge(model.graph, model.state))

        @jax.jit
        @jax.grad
        def gradient(trainable):
            found, _ = forward({**params, "trainable": trainable}, views, cams, config=config, train=True)
            return jnp.sum(jnp.sin(30 * found.layers_world)) + jnp.sum(found.keypoints_px)

        flat = leaves_with_names(jax.tree.map(np.asarray, gradient(params["trainable"])))
    assert all(np.isfinite(leaf).all() for leaf in flat.values())
    dead = {path for path, leaf in flat.items() if not leaf.any()}
    expected = {p for p in flat if p.startswith("start.shift") or p.endswith("gamma_out.bias")}
    assert dead == expected


GLOBAL, BOTH = QueryEmbedding.GLOBAL, QueryEmbedding.GLOBAL_AND_VERTEX


@pytest.mark.parametrize("kind", [GLOBAL, BOTH])
@pytest.mark.parametrize("design", Design)
def test_global_features_are_averaged_in_the_paper_and_summed_in_the_release(kind, design):
    """Of the valid views; and with twice the same view, the paper's embedding is that of one."""
    by_paper = design is Design.PAPER
    second = PoemV1(
        replace(V1 if by_paper else RELEASE, query_embedding=kind), default_hand(), rngs=nnx.Rngs(0)
    )
    start = jnp.zeros((1, NUM_QUERIES, 3))

    def embed(pooled, mask):
        return second.second.embedding(jnp.asarray(pooled), jnp.asarray(mask), *([] if by_paper else [start]))

    pooled = np.random.default_rng(0).normal(size=(1, 3, 16)).astype(np.float32)
    pooled[:, 2] = pooled[:, 0]
    one = embed(pooled, [[True, False, False]])
    assert one.shape == (1, NUM_QUERIES, 24)
    np.testing.assert_allclose(embed(np.roll(pooled, 1, 1), [[False, True, False]]), one, atol=1e-6)
    twice = np.abs(embed(pooled, [[True, False, True]]) - one).max()
    assert twice < 1e-6 if by_paper else twice > 1e-2
    assert np.abs(embed(pooled, [[False, True, False]]) - one).max() > 1e-2


def test_vertices_start_at_the_mean_of_the_joints():
    joints = np.random.default_rng(0).normal(size=(2, NUM_JOINTS, 3)).astype(np.float32)
    expected = np.broadcast_to(joints.mean(1, keepdims=True), (2, 778, 3))
    np.testing.assert_allclose(LinearMesh()(jnp.asarray(joints)), expected, atol=1e-6)


def test_one_view_alone_passes_as_phi_of_zero_in_the_release():
    aggregation = UnnormalisedAggregation(8, rngs=nnx.Rngs(0))
    aggregation.phi_in.bias[...] = jnp.arange(4.0)
    features = jnp.asarray(np.random.default_rng(0).normal(size=(1, 3, 5, 8)), jnp.float32)
    found = aggregation(features, jnp.array([[False, True, False]]))
    added = aggregation.phi_out(jax.nn.relu(jnp.arange(4.0)))
    assert np.abs(added).max() > 0.1
    np.testing.assert_allclose(found, features[:, 1] + added, atol=1e-6)


def test_aggregation_of_the_release_is_the_written_sum():
    aggregation = UnnormalisedAggregation(8, rngs=nnx.Rngs(0))
    features = np.random.default_rng(0).normal(size=(1, 3, 5, 8)).astype(np.float32)
    theta = np.asarray(aggregation.theta_out(jax.nn.relu(aggregation.theta_in(jnp.asarray(features)))))
    mixed = sum((theta[:, 1] * theta[:, j]).sum(-1, keepdims=True) * theta[:, j] for j in (2,))
    expected = features[:, 1] + aggregation.phi_out(jax.nn.relu(aggregation.phi_in(jnp.asarray(mixed))))
    found = aggregation(jnp.asarray(features), jnp.array([[False, True, True]]))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_camera_sees_its_own_centre_at_pixel_zero_in_the_release(make_scene):
    """As the points with which the release fills a ball that holds too few."""
    cams = make_scene(1, 2)[1]
    T = cams.T_cam_from_world.copy()
    T[:, 0] = np.eye(4)
    points = np.array([[[0.0, 0.0, 0.0], [0.1, -0.2, 0.5]]], np.float32)
    uv_px = np.asarray(projected_anyhow(Cameras(*map(jnp.asarray, (cams.K, T, cams.view_mask))), points))
    np.testing.assert_array_equal(uv_px[0, 0, 0], 0)
    expected, _ = project(cams.K, T, points[:, None])
    np.testing.assert_allclose(uv_px[0, 0, 1], expected[0, 0, 1], rtol=1e-5)
    np.testing.assert_allclose(uv_px[0, 1], expected[0, 1], rtol=1e-5)


@pytest.mark.parametrize("name", ["v1-wo-proj", "release-wo-proj"])
def test_grid_points_own_the_channels_of_their_depth(name):
    """Points are numbered (view, w, h, depth); a cell's channels are (depth, feature) in the paper, B_cam
    reshaped to (W, H, D, C / D), and (feature, depth) in the release."""
    view, h, w, features, depths = 2, 3, 4, 6, 4
    maps = np.random.default_rng(0).normal(size=(1, view, h, w, features * depths)).astype(np.float32)
    basis = PoemV1(CONFIGS[name], default_hand(), rngs=nnx.Rngs(0)).second.basis
    basis.enlarge = lambda channels: jnp.pad(channels, [(0, 0), (0, 0), (0, V1.width - features)])
    cams = Cameras(jnp.zeros((1, view, 3, 3)), jnp.zeros((1, view, 4, 4)), jnp.ones((1, view), bool))
    points, maps = jnp.zeros((1, 5, 3)), jnp.asarray(maps)
    places = [(0, 0, 0, 0), (1, 3, 2, 3), (1, 0, 2, 1), (0, 3, 0, 2)]
    index = [np.ravel_multi_index(place, (view, w, h, depths)) for place in places]
    index = jnp.array([[*index, -1]])
    if name == "v1-wo-proj":
        found = basis(maps, cams, points, index)
        expected = [maps[0, v, y, x].reshape(depths, features)[d] for v, x, y, d in places]
    else:
        found, _ = basis(CodedMaps(maps, maps), cams, points, points, index)
        expected = [maps[0, v, y, x].reshape(features, depths)[:, d] for v, x, y, d in places]
    np.testing.assert_array_equal(found[0, :, :features], [*expected, np.zeros(features)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"first_stage": OneStageConfig()}, "one stage needs"),
        ({"first_stage": RootConfig(1)}, "21 joints"),
        ({"design": Design.RELEASE}, "`first_stage` must have 21 joints and the `design`"),
        ({"query_embedding": QueryEmbedding.POINTS}, "points needs `design` = release"),
        ({"width": 20}, "multiple of 4 x `num_heads`"),
        (
            {"basis": BallConfig(1000, 0.1, FrustumConfig(4, 0.4, 0.8))},
            "64 grid points of one view; got 1000",
        ),
        ({"image_hw": (36, 36)}, "coarsest stride"),
        (
            {"basis_features": BasisFeatures.OWN_CAMERA, "decoder": CONFIGS["v1-wo-pt"].decoder},
            "`basis_features` must be projected .*; got own_camera",
        ),
        (
            {"width": 32, "decoder": CONFIGS["v1-wo-pt"].decoder, "basis": DEEP},
            "`width` must give each of the 6",
        ),
    ],
)
def test_bad_configs_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(V1, **change)


def test_released_embedding_and_features_go_together():
    with pytest.raises(ValueError, match="go together"):
        replace(RELEASE, basis_features=BasisFeatures.OWN_CAMERA)
    with pytest.raises(ValueError, match="needs a cuboid"):
        replace(
            RELEASE, decoder=TokenDecoderConfig(DetrConfig(2, 2, 8)), query_embedding=QueryEmbedding.VERTEX
        )
