"""MvP on micro configurations: what it does with its views, in the paper's form and in the release's."""

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, pixel_centres, project
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle, transform_points
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import MANO_FINGER_NAMES, SKELETON_FINGERS, WRIST, split_queries
from poem_jax.models.config import Design, ResNetConfig, Stem
from poem_jax.models.deformable_attention import sample_deformed
from poem_jax.models.frustum import denormalised
from poem_jax.models.frustum_config import Cuboid
from poem_jax.models.layers import NormMode
from poem_jax.models.mvp import (
    Mvp,
    PaperProjectiveAttention,
    Places,
    ReleaseProjectiveAttention,
    Scene,
    ViewLevels,
    finger_directions,
    paper_mesh,
    paper_places,
    paper_rays,
    release_mesh,
    release_places,
    release_rays,
    view_scene,
)
from poem_jax.models.mvp_config import MvpConfig, MvpDecoderConfig
from poem_jax.models.network import Draw, reconstruct
from poem_jax.models.world_frame import enter_working_frame

VIEWS = 4
PAPER = MvpConfig(
    num_views=VIEWS,
    image_hw=(32, 32),
    width=16,
    backbone=ResNetConfig(
        blocks=(1, 1, 1), channels=(8, 8, 16), bottleneck=False, stem=Stem.SPACE_TO_DEPTH, stem_channels=8
    ),
    cuboid=Cuboid((-0.3, -0.3, 0.3), (0.3, 0.3, 0.9)),
    decoder=MvpDecoderConfig(num_layers=2, num_heads=2, num_points=2, ffn_expansion=1),
)
RELEASE = replace(PAPER, design=Design.RELEASE)
METRES = 2e-5


@pytest.fixture(params=[PAPER, RELEASE], ids=lambda config: str(config.design))
def config(request) -> MvpConfig:
    return request.param


@functools.cache
def made(config: MvpConfig) -> Mvp:
    """Return a model with random weights, so that zero initial ones hide nothing."""
    model, rng = Mvp(config, default_hand(), rngs=nnx.Rngs(0)), np.random.default_rng(0)
    for path, variable in nnx.to_flat_state(nnx.state(model, (nnx.Param, nnx.BatchStat))):
        shape, name = variable.get_value().shape, path[-1]
        if name in ("scale", "variance"):
            value = rng.uniform(0.5, 1.5, shape)
        else:
            value = rng.normal(size=shape) / np.sqrt(np.prod(shape[:-1]) if name == "kernel" else 4)
        nnx.update(model, nnx.from_flat_state([(path, variable.replace(jnp.asarray(value, jnp.float32)))]))
    return model


TRACED: list[MvpConfig] = []
"""The configuration of every program that `_run` was compiled to."""


@nnx.jit
def _run(model: Mvp, views: Any, frame: Any) -> Prediction:
    TRACED.append(model.config)
    return reconstruct(model, views, frame, NormMode(), Draw())


def run(config: MvpConfig, views: np.ndarray, cams: Cameras) -> Prediction:
    frame = enter_working_frame(views, cams, None, np.float32)
    return jax.tree.map(np.asarray, _run(made(config), views, frame))


def taken(views: np.ndarray, cams: Cameras, index: Any) -> tuple[np.ndarray, Cameras]:
    return views[index], Cameras(*(leaf[index] for leaf in cams))


def gap(first: Prediction, second: Prediction) -> float:
    return float(np.abs(first.layers_world - second.layers_world).max())


# What goes in and comes out.


def test_shapes(config, make_scene):
    prediction = run(config, *make_scene(2, VIEWS))
    assert prediction.layers_world.shape == (2, 2, 799, 3)
    vertices, joints = split_queries(prediction.layers_world[:, -1], config.query_order)
    np.testing.assert_array_equal(vertices, prediction.vertices_world)
    np.testing.assert_array_equal(joints, prediction.joints_world)
    assert prediction.valid.all()
    assert prediction.root_world is None
    assert prediction.keypoints_px is None
    assert (prediction.pose is None) == (config.design is Design.RELEASE)


def test_inputs_matter(config, make_scene):
    """Guards the tests below against outputs that depend on nothing."""
    images, cams = make_scene(2, VIEWS)
    others, other_cams = make_scene(2, VIEWS, seed=1)
    same = run(config, images, cams)
    assert gap(same, run(config, others, cams)) > 1e-3
    assert gap(same, run(config, images, other_cams._replace(K=cams.K))) > 1e-3


def test_every_view_matters(config, make_scene):
    images, cams = make_scene(2, VIEWS)
    all_views = run(config, images, cams)
    for view in range(VIEWS):
        changed = images.copy()
        changed[:, view] = 255 - changed[:, view]
        assert gap(all_views, run(config, changed, cams)) > 1e-4


@pytest.mark.parametrize(
    ("count", "what_helps"), [(VIEWS - 1, "Pad with masked ones"), (VIEWS + 1, "Leave some out")]
)
def test_another_number_of_views_is_refused(config, make_scene, count, what_helps):
    with pytest.raises(ValueError, match=rf"must have {VIEWS} views.*got {count}\. {what_helps}"):
        run(config, *make_scene(2, count))


def test_changing_masks_compiles_nothing(config, make_scene):
    images, cams = make_scene(2, VIEWS)
    run(config, images, cams)
    before = len(TRACED)
    for count in range(VIEWS):
        mask = np.tile(np.arange(VIEWS) < count, (2, 1))
        prediction = run(config, images, cams._replace(view_mask=mask))
        assert np.isfinite(prediction.layers_world).all()
        np.testing.assert_array_equal(prediction.valid, count > 0)
    assert len(TRACED) == before


# Laws.


def test_masked_views_change_nothing(config, make_scene):
    images, cams = make_scene(2, VIEWS)
    cams = cams._replace(view_mask=np.array([[0, 1, 1, 0], [1, 0, 1, 1]], bool))
    hidden = ~cams.view_mask
    other, K, T = images.copy(), cams.K.copy(), cams.T_cam_from_world.copy()
    other[hidden], K[hidden], T[hidden] = 77, np.nan, 0
    assert gap(run(config, images, cams), run(config, other, Cameras(K, T, cams.view_mask))) == 0


def test_the_place_of_masked_views_changes_nothing(config, make_scene):
    images, cams = make_scene(2, VIEWS)
    mask = np.array([[1, 1, 0, 0]] * 2, bool)
    behind = run(config, images, cams._replace(view_mask=mask))
    order = [2, 0, 3, 1]
    between = taken(images, cams._replace(view_mask=mask), (slice(None), order))
    assert gap(behind, run(config, *between)) < METRES


def test_the_order_of_the_views_matters(config, make_scene):
    """The views stand side by side before a linear layer: MvP knows each by its place."""
    images, cams = make_scene(2, VIEWS)
    swapped = taken(images, cams, (slice(None), [0, 2, 1, 3]))
    assert gap(run(config, images, cams), run(config, *swapped)) > 1e-4


def test_the_world_frame_moves_the_prediction(config, make_scene):
    images, cams = make_scene(2, VIEWS)
    T_new_from_world = rigid(
        rotation_from_axis_angle(np.array([0.4, -1.1, 0.7])), np.array([0.3, -2.0, 1.0])
    ).astype(np.float32)
    moved = cams._replace(T_cam_from_world=cams.T_cam_from_world @ invert_rigid(T_new_from_world))
    expected = transform_points(T_new_from_world, run(config, images, cams).layers_world)
    np.testing.assert_allclose(run(config, images, moved).layers_world, expected, rtol=0, atol=METRES)


def changed_by_the_other_sample(config: MvpConfig, images: np.ndarray, cams: Cameras) -> float:
    """How far a sample moves where another one stands beside it."""
    twice = run(config, *taken(images, cams, [0, 0]))
    return float(np.abs(run(config, images, cams).layers_world[0] - twice.layers_world[0]).max())


def test_a_sample_of_the_paper_does_not_see_its_batch(make_scene):
    assert changed_by_the_other_sample(PAPER, *make_scene(2, VIEWS)) < METRES


def test_a_sample_of_the_release_sees_its_batch(make_scene):
    """Through the largest projected number, which all projections are divided by."""
    images, cams = make_scene(2, VIEWS)
    cams.K[1] *= np.array([[2.0], [2.0], [1.0]], np.float32)
    assert changed_by_the_other_sample(RELEASE, images, cams) > 1e-4


def test_padding_samples_do_not_couple_the_release(make_scene):
    images, cams = make_scene(2, VIEWS)
    cams = cams._replace(view_mask=np.array([[1] * VIEWS, [0] * VIEWS], bool))
    assert changed_by_the_other_sample(RELEASE, images, cams) < METRES


# Training.


def shallow(config: MvpConfig) -> MvpConfig:
    """With one layer: gradients take long to compile."""
    return replace(config, decoder=replace(config.decoder, num_layers=1))


@functools.partial(jax.jit, static_argnames="graph")
@functools.partial(jax.value_and_grad, argnums=(0, 1))
def loss_and_slopes(
    weights: Any, T: Any, graph: Any, rest: Any, images: Any, cams: Cameras, target: Any, key: Any
) -> Any:
    """Distance of all points of the mesh, and of the joints from its middle."""
    # Copies, which the norms may move in this trace.
    model: Mvp = nnx.merge(graph, weights, jax.tree.map(jnp.asarray, rest))
    frame = enter_working_frame(images, cams._replace(T_cam_from_world=T), None, np.float32)
    mode = NormMode(jnp.reshape(frame.cams.view_mask, -1))
    found = reconstruct(model, images, frame, mode, Draw(), key)
    middle = target.mean(-2, keepdims=True)
    return jnp.abs(found.vertices_world - target).mean() + jnp.abs(found.joints_world - middle).mean()


def target(cams: Cameras) -> np.ndarray:
    """A flat hand half a metre before each primary camera."""
    hand = default_hand()
    flat = hand_mesh(hand, np.zeros((16, 3), np.float32), np.zeros(10, np.float32), center_joint=WRIST)
    in_camera = flat.vertices + np.array([0.02, 0.03, 0.6], np.float32)
    return transform_points(invert_rigid(cams.T_cam_from_world[:, 0]), in_camera)


def learn(model: Mvp, images: np.ndarray, cams: Cameras, key: int = 0) -> Any:
    graph, weights, rest = nnx.split(model, nnx.Param, ...)
    T = jnp.asarray(cams.T_cam_from_world)
    goal = target(cams)
    return loss_and_slopes(weights, T, graph, rest, images, cams, goal, jax.random.key(key))


def test_gradients_are_finite_and_reach_all_weights(config, make_scene):
    _, slopes = learn(made(shallow(config)), *make_scene(2, VIEWS))
    for leaf in jax.tree.leaves(slopes):
        assert np.isfinite(leaf).all()
        assert np.abs(leaf).max() > 0


def test_gradients_are_finite_where_views_are_missing(config, make_scene):
    images, cams = make_scene(2, VIEWS)
    masked = cams._replace(view_mask=np.array([[0, 1, 0, 0], [0] * VIEWS], bool))
    _, slopes = learn(made(shallow(config)), images, masked)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_dropout_draws_from_its_key(config, make_scene):
    scene = make_scene(2, VIEWS)
    first, again, second = (float(learn(made(shallow(config)), *scene, key=key)[0]) for key in (0, 0, 1))
    assert first == again
    assert abs(first - second) > 1e-5


# Parts.


def in_primary(cams: Cameras) -> Cameras:
    return enter_working_frame(np.zeros((*cams.view_mask.shape, 1, 1, 3)), cams, None, np.float32).cams


def test_paper_rays_go_through_the_centres_of_cells(make_scene):
    cams = in_primary(make_scene(2, VIEWS)[1])
    rays = np.asarray(paper_rays(cams, (4, 2), (32, 32)))
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-6)
    centres = invert_rigid(np.asarray(cams.T_cam_from_world))[..., :3, 3]
    points = centres[:, :, None] + 0.8 * rays.reshape(2, VIEWS, -1, 3)
    uv_px, depth = project(cams.K, cams.T_cam_from_world, points)
    expected = pixel_centres((4, 2)) * np.array([16, 8])
    assert (np.asarray(depth) > 0).all()
    np.testing.assert_allclose(uv_px, np.broadcast_to(expected.reshape(-1, 2), uv_px.shape), atol=1e-3)


def test_release_rays_are_turned_the_wrong_way(make_scene):
    """Through index x stride, and by the rotation into the camera; the primary view's are right but for the
    half cell."""
    cams = in_primary(make_scene(1, VIEWS)[1])
    rays = np.asarray(release_rays(cams, (4, 2), (32, 32)))
    R_cam_from_primary = np.asarray(cams.T_cam_from_world)[..., :3, :3]
    in_cam = np.einsum("bvji,bvhwj->bvhwi", R_cam_from_primary, rays)
    uv_px = np.einsum("bvij,bvhwj->bvhwi", np.asarray(cams.K), in_cam / in_cam[..., 2:])[..., :2]
    expected = (pixel_centres((4, 2)) - 0.5) * np.array([16, 8])
    np.testing.assert_allclose(uv_px, np.broadcast_to(expected, uv_px.shape), atol=1e-3)


def scene_of(cams: Cameras, size: int = 4) -> Scene:
    levels = tuple(jnp.zeros((*cams.view_mask.shape, n, n, 2)) for n in (size // 2, size, 2 * size))
    return Scene(levels, (), cams)


def test_paper_places_are_projections(make_scene):
    cams, rng = in_primary(make_scene(2, VIEWS)[1]), np.random.default_rng(0)
    shares = rng.uniform(0, 1, (2, 21, 3)).astype(np.float32)
    places = paper_places(PAPER, shares, scene_of(cams))
    points = denormalised(shares, PAPER.cuboid)
    uv_px, _ = project(cams.K, cams.T_cam_from_world, points[:, None])
    for level in range(3):
        np.testing.assert_allclose(places.uv_share[..., level, :] * 32, uv_px, rtol=1e-5, atol=1e-4)


def test_nothing_is_read_behind_a_camera(make_scene):
    _, cams = make_scene(1, VIEWS)
    cams = in_primary(cams)
    behind = np.full((1, 21, 3), [0.5, 0.5, -3.0], np.float32)
    assert not np.asarray(paper_places(PAPER, behind, scene_of(cams)).is_seen)[:, 0].any()
    assert np.asarray(release_places(RELEASE, behind, scene_of(cams)).is_seen).all()


def test_release_places_are_shares_of_the_largest_number_in_the_batch(make_scene):
    cams, rng = in_primary(make_scene(2, VIEWS)[1]), np.random.default_rng(0)
    cams = cams._replace(view_mask=np.array([[1, 1, 1, 0], [1, 1, 1, 1]], bool))
    shares = rng.uniform(0.3, 0.7, (2, 21, 3)).astype(np.float32)
    places = np.asarray(release_places(RELEASE, shares, scene_of(cams)).uv_share)
    uv_px, _ = project(cams.K, cams.T_cam_from_world, denormalised(shares, RELEASE.cuboid)[:, None])
    for level, size in enumerate((2, 4, 8)):
        enlarged = np.asarray(uv_px) * size / (size - 1)
        ratio = places[..., level, :] / enlarged
        np.testing.assert_allclose(ratio, ratio.flat[0], rtol=1e-4)
    assert places[np.asarray(cams.view_mask)].max() == 1


def test_masked_views_are_zeros_after_the_valid_ones(config, make_scene):
    _, cams = make_scene(1, VIEWS)
    frame = in_primary(cams._replace(view_mask=np.array([[0, 1, 0, 1]], bool)))
    rng = np.random.default_rng(0)
    seen = ViewLevels(
        tuple(rng.normal(size=(1, VIEWS, n, n, config.width)).astype(np.float32) for n in (2, 4, 8))
    )
    scene = view_scene(config, seen, frame)
    np.testing.assert_array_equal(scene.cams.view_mask, [[True, True, False, False]])
    for ours, level in zip(scene.levels, seen.levels, strict=True):
        np.testing.assert_array_equal(ours[:, :2], level[:, [1, 3]])
        assert not np.asarray(ours[:, 2:]).any()
    queries = rng.normal(size=(1, 21, config.width)).astype(np.float32)
    everywhere = Places(
        np.full((1, VIEWS, 21, 3, 2), 0.5, np.float32), np.array([[[True] * 21] * 2 + [[False] * 21] * 2])
    )
    read = np.asarray(made(config).layers[0].projective_attention(queries, everywhere, scene))
    assert np.abs(read[:, :2]).min(-1).max() > 0
    assert not read[:, 2:].any()


def test_the_release_reads_levels_and_heads_out_of_order():
    # Of 3 levels, 2 heads and 4 points; a number tells its level and place.
    numbers = jnp.arange(3 * 8.0).reshape(1, 1, 1, 3, 8)
    decoder = replace(PAPER.decoder, num_points=4)
    paper, release = (
        kind(decoder, 16, rngs=nnx.Rngs(0))._by_head(numbers, 1)[0, 0, 0, ..., 0]
        for kind in (PaperProjectiveAttention, ReleaseProjectiveAttention)
    )
    for head in range(2):
        for level in range(3):
            own = 8 * level + 4 * head + np.arange(4)
            np.testing.assert_array_equal(paper[head, level], own)
            np.testing.assert_array_equal(release[head, level], 12 * head + 4 * level + np.arange(4))


def test_deformed_samples_are_read_where_told():
    """A map that holds its own coordinates gives the place back; every head has its own place."""
    rng = np.random.default_rng(0)
    levels = []
    for hw in ((4, 6), (8, 12)):
        share = pixel_centres(hw) / np.array(hw[::-1])
        levels.append(jnp.asarray(np.concatenate([share, share + 10], -1), jnp.float32)[None])
    locations = rng.uniform(0.2, 0.8, (1, 5, 2, 2, 3, 2)).astype(np.float32)
    weights = rng.dirichlet(np.ones(6), (1, 5, 2)).reshape(1, 5, 2, 2, 3).astype(np.float32)
    read = np.asarray(jax.jit(sample_deformed)(tuple(levels), locations, weights)).reshape(1, 5, 2, 2)
    expected = (weights[..., None] * locations).sum((3, 4)) + np.array([0, 10])[:, None]
    np.testing.assert_allclose(read, expected, atol=1e-5)


def test_outside_the_maps_there_are_zeros():
    maps = (jnp.ones((1, 4, 4, 2)),)
    far = np.full((1, 1, 1, 1, 1, 2), 7.0, np.float32)
    assert (np.asarray(jax.jit(sample_deformed)(maps, far, np.ones((1, 1, 1, 1, 1), np.float32))) == 0).all()


# The hand.


def test_finger_directions_are_orthonormal_and_each_moves_one_finger():
    hand = default_hand()
    directions = finger_directions(hand)
    np.testing.assert_allclose(directions @ directions.T, np.eye(15), atol=1e-6)
    flat = np.zeros((16, 3), np.float32)
    shape = np.zeros(10, np.float32)
    at_rest = hand.shape(shape).pose(flat).rotations
    for i, direction in enumerate(directions):
        pose = np.concatenate([flat[:1], 0.5 * direction.reshape(15, 3)])
        turned = np.abs(hand.shape(shape).pose(pose).rotations - at_rest).max((-2, -1)) > 1e-3
        assert set(np.flatnonzero(turned)) <= set(SKELETON_FINGERS[i // 3])
        assert turned.any()


def test_the_first_and_last_direction_of_a_finger_bend_it_into_the_palm():
    """The palm of a resting hand faces -y; the thumb bends across it."""
    hand, shape = default_hand(), np.zeros(10, np.float32)
    for i, name in enumerate(MANO_FINGER_NAMES):
        if name == "thumb":
            continue
        for direction in finger_directions(hand)[[3 * i, 3 * i + 2]]:
            pose = np.concatenate([np.zeros((1, 3), np.float32), 0.5 * direction.reshape(15, 3)])
            bent, flat = (hand_mesh(hand, p, shape).vertices for p in (pose, np.zeros_like(pose)))
            moved = bent - flat
            assert moved[np.linalg.norm(moved, axis=-1).argmax(), 1] < -0.005


def test_the_paper_s_parameters_are_its_mesh(make_scene):
    found = run(PAPER, *make_scene(2, VIEWS))
    mesh = hand_mesh(default_hand(), found.pose, found.shape, found.translation)
    np.testing.assert_allclose(mesh.vertices, found.vertices_world, rtol=0, atol=METRES)
    np.testing.assert_allclose(mesh.joints[:, WRIST], found.joints_world[:, WRIST], rtol=0, atol=METRES)


def test_the_release_stretches_its_mesh_with_the_cuboid():
    """Metres of the hand are taken for shares; in the paper's form the cuboid says where the wrist is."""
    hand = default_hand()
    mesh = hand_mesh(hand, np.zeros((16, 3), np.float32), np.zeros(10, np.float32), center_joint=WRIST)
    config = replace(PAPER, cuboid=Cuboid((0.0, 0.0, 0.0), (2.4, 2.4, 1.8)))
    shares = np.random.default_rng(0).uniform(size=(21, 3)).astype(np.float32)
    size = np.ptp(mesh.vertices, 0)
    for place, scale in ((paper_mesh, [1, 1, 1]), (release_mesh, [2.4, 2.4, 1.8])):
        placed = place(mesh, shares, config)
        np.testing.assert_allclose(np.ptp(np.asarray(placed.vertices), 0), size * scale, rtol=1e-5)
        np.testing.assert_allclose(placed.joints, shares * [2.4, 2.4, 1.8], rtol=1e-5)


# Bad configurations.


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_views": 0}, "num_views"),
        ({"width": 18, "decoder": MvpDecoderConfig(num_heads=4)}, "num_heads"),
        ({"image_hw": (40, 32)}, "coarsest stride"),
        ({"design": Design.RELEASE, "image_hw": (16, 32)}, "more than one cell"),
        ({"backbone": ResNetConfig(blocks=(1, 1), channels=(8, 8), bottleneck=False)}, "at least 3 stages"),
        ({"image_std": 0.0}, "image_std"),
    ],
)
def test_bad_configurations_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(PAPER, **change)


def test_bad_decoder_configurations_are_refused():
    with pytest.raises(ValueError, match="dropout"):
        MvpDecoderConfig(dropout=1.0)
