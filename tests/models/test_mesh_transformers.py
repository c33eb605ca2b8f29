"""PE-MeshTR and FTL-MeshTR in both designs: their equations in NumPy, and the laws of all systems."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.cameras import Cameras
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.models import network
from poem_jax.models.apply import _predict, apply, init
from poem_jax.models.config import Design, FrozenNorms, ResNetConfig, Stem
from poem_jax.models.detr_config import DetrConfig
from poem_jax.models.frustum_config import Cuboid, FrustumConfig
from poem_jax.models.infer import infer, prepare
from poem_jax.models.layers import NormMode
from poem_jax.models.mesh_transformer_config import (
    FTL_MESHTR,
    PE_MESHTR,
    CanonicalFusion,
    MeshTransformerConfig,
    PositionEmbeddedFusion,
    ftl_meshtr_release,
    pe_meshtr_release,
)
from poem_jax.models.mesh_transformers import (
    CanonicalMaps,
    EmbeddedPositions,
    MeshTransformer,
    PixelUnitMaps,
    grid_point_code,
)
from poem_jax.models.world_frame import enter_working_frame
from tests.precision import as_float64

_TRUNK = ResNetConfig(
    blocks=(1, 1, 1), channels=(8, 8, 16), bottleneck=False, stem=Stem.SPACE_TO_DEPTH, stem_channels=8
)
_PE_PAPER = MeshTransformerConfig(
    fusion=PositionEmbeddedFusion(FrustumConfig(num_depths=2)),
    image_hw=(32, 32),
    width=16,
    backbone=_TRUNK,
    decoder=DetrConfig(num_layers=2, num_heads=2, ffn_width=16),
)
_RELEASE: dict[str, Any] = {
    "design": Design.RELEASE,
    "backbone": replace(_TRUNK, blocks=(1, 2), channels=(8, 16), frozen_norms=FrozenNorms.STAGE_STARTS),
    "cuboid": Cuboid((-0.5, -0.4, 0.1), (0.6, 0.4, 1.1)),
}
_FTL: dict[str, Any] = {"fusion": CanonicalFusion(num_points=3, num_views=5)}
MICRO = {
    "pe": _PE_PAPER,
    "pe-release": replace(_PE_PAPER, **_RELEASE),
    "ftl": replace(_PE_PAPER, **_FTL),
    "ftl-release": replace(_PE_PAPER, **_RELEASE, **_FTL),
}
SAME_M, OTHER_M = 5e-6, 1e-4
"""What rounding makes at most, and what a difference makes at least: points are up to a metre apart."""
NUM_VIEWS = 4
"""Of almost all runs, so that each model is compiled once."""


@functools.cache
def params_of(name: str) -> dict:
    """Return fresh weights, shaken, so that no bias is zero and no norm is one."""
    params, rng = init(MICRO[name], key=jax.random.key(0)), np.random.default_rng(0)

    def shaken(leaf):
        return leaf + 0.1 * rng.normal(size=leaf.shape).astype(np.float32)

    statistics = jax.tree.map(lambda leaf: jnp.abs(shaken(leaf)) + 0.1, params["statistics"])
    return {**params, "trainable": jax.tree.map(shaken, params["trainable"]), "statistics": statistics}


@pytest.fixture(params=MICRO)
def name(request) -> str:
    return request.param


@pytest.fixture
def scene(make_scene) -> tuple[np.ndarray, Cameras]:
    """Return two samples of four views, extrinsics in float64 so that moving worlds rounds nothing."""
    views, cams = make_scene(2, NUM_VIEWS)
    return views, cams._replace(T_cam_from_world=cams.T_cam_from_world.astype(np.float64))


def predicted(name: str, views: np.ndarray, cams: Cameras, params: dict | None = None) -> np.ndarray:
    """Return the points of all layers, in the world."""
    params = params_of(name) if params is None else params
    return np.asarray(apply(params, views, cams, config=MICRO[name]).layers_world)


def before_primary(points: np.ndarray, cams: Cameras) -> np.ndarray:
    """Move points (batch, layer, 799, 3) into the frame of the first camera."""
    T = np.asarray(cams.T_cam_from_world)[:, :1]
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def chosen(views: np.ndarray, cams: Cameras, index: Any) -> tuple[np.ndarray, Cameras]:
    return views[index], Cameras(*(leaf[index] for leaf in cams))


def amid_garbage(views: np.ndarray, cams: Cameras, places: list[int]) -> tuple[np.ndarray, Cameras]:
    """Put as many views as there are `places` there, among masked ones that hold garbage."""
    rng, shape = np.random.default_rng(len(places) + places[-1]), views.shape[:2]
    wide = rng.integers(0, 256, views.shape, np.uint8)
    K, T = np.full((*shape, 3, 3), np.nan, np.float32), rng.normal(size=(*shape, 4, 4))
    mask, count = np.zeros(shape, bool), len(places)
    wide[:, places], mask[:, places] = views[:, :count], True
    K[:, places], T[:, places] = cams.K[:, :count], cams.T_cam_from_world[:, :count]
    return wide, Cameras(K, T, mask)


# Laws.


def test_points_lie_in_the_cuboid_before_the_primary_camera(name, scene):
    views, cams = scene
    prediction = apply(params_of(name), views, cams, config=MICRO[name])
    absent = (prediction.root_world, prediction.keypoints_px, prediction.heat_maps, prediction.pose)
    assert absent == (None,) * 4
    assert prediction.valid.all()
    points, cuboid = before_primary(np.asarray(prediction.layers_world), cams), MICRO[name].cuboid
    assert points.shape == (2, 2, 799, 3)
    assert np.all((np.array(cuboid.low) - SAME_M <= points) & (points <= np.array(cuboid.high) + SAME_M))
    assert points.std((0, 1, 2)).min() > 0.01
    assert np.abs(points[:, 0] - points[:, 1]).max() > OTHER_M


def test_start_points_are_where_offsets_of_zero_leave_them(name, scene):
    params = params_of(name)
    still = jax.tree.map(jnp.zeros_like, params["trainable"]["offsets"])
    points = predicted(name, *scene, {**params, "trainable": {**params["trainable"], "offsets": still}})
    low, high = (np.array(end) for end in (MICRO[name].cuboid.low, MICRO[name].cuboid.high))
    start = np.full((799, 3), 0.5)
    if MICRO[name].design is Design.RELEASE:
        start = 1 / (1 + np.exp(-np.asarray(params["trainable"]["queries"]["points"])))
    expected = np.broadcast_to(low + start * (high - low), points.shape)
    np.testing.assert_allclose(before_primary(points, scene[1]), expected, atol=SAME_M)


def test_masked_views_change_nothing(name, scene):
    """In float64: rounding moves single points of the released FTL-MeshTR by tenths of a millimetre."""
    with jax.enable_x64(True):
        params = as_float64(params_of(name))
        behind, between = (
            predicted(name, *as_float64(amid_garbage(*scene, places)), params)
            for places in ([0, 1, 2], [0, 2, 3])
        )
    np.testing.assert_allclose(behind, between, atol=1e-12)


@pytest.mark.parametrize("name", ["pe", "ftl"])
def test_padding_changes_nothing(name, scene):
    """Those of the release run so on their goldens."""
    short = predicted(name, *chosen(*scene, (slice(None), slice(3))))
    np.testing.assert_allclose(predicted(name, *amid_garbage(*scene, [0, 1, 3])), short, atol=SAME_M)


def test_every_view_matters(name, scene):
    views, cams = scene
    whole = predicted(name, views, cams)
    for view in range(NUM_VIEWS):
        mask = np.ones((2, NUM_VIEWS), bool)
        mask[:, view] = False
        assert np.abs(predicted(name, views, cams._replace(view_mask=mask)) - whole).max() > OTHER_M


def test_the_prediction_moves_with_the_world(name, scene):
    views, cams = scene
    R, t = rotation_from_axis_angle(np.array([0.3, -1.1, 0.7])), np.array([2.0, -3.0, 1.0])
    moved = cams._replace(T_cam_from_world=cams.T_cam_from_world @ rigid(R.T, -R.T @ t))
    expected = predicted(name, views, cams) @ R.T + t
    np.testing.assert_allclose(predicted(name, views, moved), expected, atol=SAME_M)


def test_a_sample_does_not_see_its_batch(name, scene, make_scene):
    views, cams = scene
    other_views, other_cams = make_scene(1, NUM_VIEWS, seed=1)
    mixed = Cameras(
        *(np.concatenate([x[:1], y.astype(x.dtype)]) for x, y in zip(cams, other_cams, strict=True))
    )
    mixed.view_mask[1, 1:] = False
    whole = predicted(name, views, cams)
    changed = predicted(name, np.concatenate([views[:1], other_views]), mixed)
    np.testing.assert_array_equal(changed[0], whole[0])
    assert np.abs(changed[1] - whole[1]).max() > OTHER_M


@pytest.mark.parametrize("part", ["K", "T"])
def test_cameras_matter_though_nothing_is_projected(name, scene, part):
    """The paper's FTL-MeshTR has no use for K: its features are moved by extrinsics alone."""
    views, cams = scene
    if part == "K":
        other = cams._replace(K=cams.K * np.array([1.1, 1.1, 1], np.float32)[:, None])
    else:
        other = cams._replace(T_cam_from_world=cams.T_cam_from_world.copy())
        other.T_cam_from_world[:, 1, :3, 3] += 0.05
    gap = np.abs(predicted(name, views, other) - predicted(name, views, cams)).max()
    assert gap == 0 if (name, part) == ("ftl", "K") else gap > OTHER_M


ARE_A_SET = {"pe": True, "pe-release": False, "ftl": False, "ftl-release": False}
"""Whether the other views than the primary may change places. The release tells keys the number of their
view, and so does our FTL-MeshTR of the paper, whose convolution has weights for each view besides."""


def test_whether_the_order_of_the_other_views_matters(name, scene):
    turned = predicted(name, *chosen(*scene, (slice(None), [0, 3, 1, 2])))
    gap = np.abs(turned - predicted(name, *scene)).max()
    assert gap <= SAME_M if ARE_A_SET[name] else gap > OTHER_M


def test_one_program_for_any_number_of_views(name, scene):
    views, cams = scene
    programs = set()
    for count in range(1, NUM_VIEWS + 1):
        mask = np.broadcast_to(np.arange(NUM_VIEWS) < count, (2, NUM_VIEWS)).copy()
        assert np.isfinite(predicted(name, views, cams._replace(view_mask=mask))).all()
        programs.add(_predict._cache_size())
    assert len(programs) == 1


def test_samples_without_a_view_are_flagged_and_finite(name, scene):
    views, cams = scene
    mask = np.array([[False] * NUM_VIEWS, [True] * NUM_VIEWS])
    frame = enter_working_frame(views, cams._replace(view_mask=mask), None, np.float32)
    prediction = _predict(params_of(name), views, frame, network.Draw(), config=MICRO[name])
    np.testing.assert_array_equal(prediction.valid, [False, True])
    assert np.isfinite(prediction.layers_world).all()


def test_infer_gives_what_apply_gives(scene):
    views, cams = scene
    cams = cams._replace(view_mask=np.array([[1, 0, 1, 1], [0, 1, 0, 0]], bool))
    fast = infer(prepare(params_of("ftl"), MICRO["ftl"]), views, cams)
    np.testing.assert_allclose(fast.layers_world, predicted("ftl", views, cams), atol=SAME_M)


# Training.


def test_a_step_down_the_gradient_lowers_the_loss(name, scene):
    """All gradients are finite, those of cameras too; norms move but for the frozen."""
    config, params = MICRO[name], params_of(name)
    views, cams = amid_garbage(*scene, [0, 1, 3])
    target = predicted(name, views, cams)[:, -1:] + np.array([0.05, -0.03, 0.02], np.float32)

    @jax.jit
    def loss_and_gradients(trainable, K, T):
        def loss(trainable, K, T):
            now, given = {**params, "trainable": trainable}, Cameras(K, T, cams.view_mask)
            prediction, statistics = network.forward(now, views, given, config=config, train=True)
            return jnp.mean(jnp.abs(prediction.layers_world - target)), statistics

        return jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)(trainable, K, T)

    given = [np.nan_to_num(leaf).astype(np.float32) for leaf in cams[:2]]
    (before, statistics), gradients = loss_and_gradients(params["trainable"], *given)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    silent = {path for path, g in network.leaves_with_names(gradients[0]).items() if not np.any(g)}
    assert silent <= {path for path in network.leaves_with_names(gradients[0]) if _may_be_silent(path)}

    square = sum(np.sum(np.square(leaf)) for leaf in jax.tree.leaves(gradients[0]))
    step = 0.02 * before / square
    lowered = jax.tree.map(lambda leaf, gradient: leaf - step * gradient, params["trainable"], gradients[0])
    assert loss_and_gradients(lowered, *given)[0][0] < before

    moved = network.leaves_with_names(statistics)
    frozen = {path.rpartition(".")[0] for path in moved if path.endswith("scale")}
    assert bool(frozen) == (config.design is Design.RELEASE)
    for path, old in network.leaves_with_names(params["statistics"]).items():
        assert np.array_equal(old, moved[path]) == (path.rpartition(".")[0] in frozen), path


def _may_be_silent(path: str) -> bool:
    """A bias of all keys changes no softmax; and embeddings start at zero, so that in the first layer all
    values are the bias, whoever is read."""
    in_first = path.startswith("decoder.layers.0.self_attention.")
    return path.endswith("key.bias") or (
        in_first and not path.endswith(("value.bias", "out.bias", "out.kernel"))
    )


def test_dropout_has_a_key(scene):
    @jax.jit
    def points(key):
        prediction, _ = network.forward(params_of("pe"), *scene, config=MICRO["pe"], train=True, key=key)
        return prediction.layers_world

    first, again, other = (points(jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > OTHER_M


# Equations.

WIDTH, MAP_HW = 16, (4, 4)
RNG = np.random.default_rng(2)
MAPS = RNG.normal(size=(1, 3, *MAP_HW, WIDTH)).astype(np.float32)


def _fusion(name: str, kind: Callable) -> Any:
    module = network.assemble(MICRO[name], params_of(name))
    assert isinstance(module, MeshTransformer)
    assert isinstance(module.fusion, kind)
    return module.fusion


def _cameras(make_scene) -> tuple[Cameras, np.ndarray, np.ndarray, np.ndarray]:
    """Return cameras, and K, R and t of them in float64."""
    _, cams = make_scene(1, 3)
    T = cams.T_cam_from_world[0].astype(np.float64)
    return cams, cams.K[0].astype(np.float64), T[:, :3, :3], T[:, :3, 3]


def test_position_embedded_fusion_of_the_paper(make_scene):
    """B_W = (reshape(B_cam, (W, H, D, C / D)) + f_M(T^-1 M_cam)), flattened."""
    cams, K, R, t = _cameras(make_scene)
    config, tokens = MICRO["pe"], _fusion("pe", EmbeddedPositions)(MAPS, cams, NormMode())
    assert tokens.codes is None
    low, high = np.array(config.cuboid.low), np.array(config.cuboid.high)
    for view in range(3):
        for row, column in ((0, 0), (1, 3), (3, 2)):
            expected = MAPS[0, view, row, column].astype(np.float64)
            for d, depth in enumerate((0.2, 0.2 + 1.8 * 2 / 6)):
                ray = np.linalg.inv(K[view]) @ np.array([8 * column + 4, 8 * row + 4, 1.0])
                share = (R[view].T @ (depth * ray - t[view]) - low) / (high - low)
                angles = np.pi * np.array([*share, 2 * share[0]])
                waves = np.stack([np.sin(angles), np.cos(angles)], -1).ravel()
                expected[8 * d : 8 * d + 8] += waves
            token = tokens.values[0, 16 * view + 4 * row + column]
            np.testing.assert_allclose(token, expected, atol=2e-5)


def test_opposite_faces_of_the_cuboid_have_other_codes():
    faces = grid_point_code(jnp.asarray([[0.0, 0.5, 0.5], [1.0, 0.5, 0.5]]), 8)
    assert np.abs(faces[0] - faces[1]).max() > 1


def _conv_norm(layer, x: np.ndarray) -> np.ndarray:
    kernel, bias = np.asarray(layer.conv.kernel[...])[0, 0], np.asarray(layer.conv.bias[...])
    scale, shift, mean, variance = (
        np.asarray(leaf[...], np.float64)
        for leaf in (layer.norm.scale, layer.norm.bias, layer.norm.mean, layer.norm.variance)
    )
    y = (x @ kernel + bias - mean) / np.sqrt(variance + 1e-5) * scale + shift
    return np.maximum(y, 0) if layer.relu else y


def _linear(kernel: np.ndarray, bias: np.ndarray, x: np.ndarray) -> np.ndarray:
    return x @ kernel + bias


def test_canonical_fusion_of_the_paper(make_scene):
    """Every view's points by T^-1; all views through one convolution, whose other weights meet nothing."""
    cams, _, R, t = _cameras(make_scene)
    fusion = _fusion("ftl", CanonicalMaps)
    tokens = fusion(MAPS, cams, NormMode())
    to_points, fuse = (
        (np.asarray(layer.kernel[...])[0, 0], np.asarray(layer.bias[...]))
        for layer in (fusion.to_points, fusion.fuse)
    )
    for row, column in ((0, 0), (2, 3)):
        joined = np.zeros((5, 3, 3))
        for view in range(3):
            points = _linear(*to_points, MAPS[0, view, row, column]).reshape(3, 3)
            joined[view] = (points - t[view]) @ R[view]
        fused = _linear(*fuse, joined.ravel()).reshape(5, WIDTH)
        for view in range(3):
            token = tokens.values[0, 16 * view + 4 * row + column]
            np.testing.assert_allclose(token, fused[view], atol=2e-5)


def test_canonical_fusion_of_the_release(make_scene):
    """Channel = xyz x points: K^-1 T^-1 in homogeneous coordinates, then K T, without any division."""
    cams, K, R, t = _cameras(make_scene)
    fusion = _fusion("ftl-release", PixelUnitMaps)
    tokens = fusion(MAPS, cams, NormMode())
    for view in range(3):
        for row, column in ((0, 0), (2, 3)):
            points = _conv_norm(fusion.to_points, MAPS[0, view, row, column]).reshape(3, -1)
            points = np.linalg.inv(K[view]) @ (R[view].T @ (points - t[view][:, None]))
            points = _conv_norm(fusion.between, points.ravel()).reshape(3, -1)
            points = K[view] @ (R[view] @ points + t[view][:, None])
            token = tokens.values[0, 16 * view + 4 * row + column]
            np.testing.assert_allclose(
                token, _conv_norm(fusion.from_points, points.ravel()), rtol=1e-4, atol=1e-4
            )


# Configurations.


def test_named_configurations():
    assert PE_MESHTR.query_order is FTL_MESHTR.query_order is not pe_meshtr_release().query_order
    assert pe_meshtr_release() == pe_meshtr_release("dexycb")
    assert pe_meshtr_release("ho3d").fusion.frustum.end == 1.2
    assert ftl_meshtr_release("oakink").cuboid.high == (1.0, 1.0, 1.5)
    shapes = [network.describe(config)["trainable"] for config in (PE_MESHTR, FTL_MESHTR)]
    counts = [sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(tree)) for tree in shapes]
    assert all(2e7 < count < 5e7 for count in counts)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "pe",
            {"width": 20, "fusion": PositionEmbeddedFusion(FrustumConfig(3))},
            "each of the 3 points along",
        ),
        ("pe", {"width": 8}, "each of the 2 points along a ray .* at least 6"),
        ("ftl", {"width": 18}, "multiple of 4"),
        ("ftl", {"decoder": DetrConfig(num_heads=3)}, "multiple of `num_heads` = 3"),
        ("pe", {"stride": 32}, "`stride` must be one of"),
        ("pe-release", {"stride": 4}, "`backbone` must end at `stride`"),
        ("pe", {"image_hw": (36, 32)}, "multiples of the trunk's coarsest stride"),
        ("pe", {"image_std": 0.0}, "`image_std` positive"),
    ],
)
def test_what_a_mesh_transformer_cannot_be(name: str, change: dict, message: str):
    with pytest.raises(ValueError, match=message):
        replace(MICRO[name], **change)


def test_unknown_data_sets_and_counts():
    with pytest.raises(ValueError, match="`dataset` must be one of dexycb, ho3d, oakink; got 'arctic'"):
        pe_meshtr_release("arctic")
    with pytest.raises(ValueError, match="num_views"):
        CanonicalFusion(num_views=0)


def test_more_views_than_the_paper_s_convolution_has_weights_for(make_scene):
    with pytest.raises(ValueError, match=r"`views` must have 1 to 5 views.*; got 6"):
        predicted("ftl", *make_scene(1, 6))
    with pytest.raises(ValueError, match=r"`views` must have 1 to 5 views.*; got 6"):
        network.forward(params_of("ftl"), *make_scene(1, 6), config=MICRO["ftl"], train=True)
    assert MICRO["ftl-release"].view_range == MICRO["pe"].view_range == (1, None)


def test_a_root_is_of_no_use(make_scene):
    views, cams = make_scene(1, 3)
    with pytest.raises(ValueError, match="`root_world` must be None"):
        apply(params_of("pe"), views, cams, config=MICRO["pe"], root_world=np.zeros((1, 3), np.float32))
