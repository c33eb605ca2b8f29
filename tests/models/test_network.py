"""The whole model on a micro config: invariances, gradients, transformations, compilations."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.cameras import Cameras
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle, skew_matrix, transform_points
from poem_jax.hand.model import HandModel, hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.models.apply import _predict, apply, init
from poem_jax.models.network import describe, forward, leaves_with_names
from tests.precision import as_float64

CONFIGS = ("micro_config", "joints_config", "parametric_config")
METRES = 2e-5


@pytest.fixture(params=CONFIGS)
def model(request, make_params):
    """Return `apply` with one of the micro configs.

    Every basis point is a neighbour of every query: which of two equally near points is taken would depend on
    rounding, and the tests below compare exactly what rounding may not change.
    """
    config = request.getfixturevalue(request.param)
    config = replace(config, decoder=replace(config.decoder, num_neighbours=config.basis.num_points))
    return functools.partial(apply, make_params(config), config=config)


@pytest.fixture
def micro(micro_config, make_params):
    return functools.partial(apply, make_params(micro_config), config=micro_config)


def _points(prediction):
    return np.asarray(prediction.layers_world)


def _take_views(views, cams, order):
    return views[:, order], Cameras(*(array[:, order] for array in cams))


def _mask(cams, mask):
    return cams._replace(view_mask=np.array(mask, bool))


# Most tests share one program per config, of 2 samples and 4 views: compiling is what costs time here.


def test_shapes(model, make_scene):
    prediction = model(*make_scene(2, 4))
    layers = prediction.layers_world.shape[1]
    assert prediction.vertices_world.shape == (2, 778, 3)
    assert prediction.joints_world.shape == (2, 21, 3)
    assert prediction.layers_world.shape == (2, layers, 799, 3)
    config = model.keywords["config"]
    before = 0 if config.joint_decoder is None else config.joint_decoder.num_layers
    assert layers == before + config.decoder.num_layers
    assert prediction.keypoints_px.shape[:2] == (2, 4)
    assert prediction.valid.all()
    np.testing.assert_array_equal(prediction.layers_world[:, -1, :778], prediction.vertices_world)


def test_inputs_matter(model, make_scene):
    """Guards the tests below against outputs that depend on nothing."""
    first, second = (model(*make_scene(2, 4, seed)) for seed in (0, 1))
    root_relative = [_points(p) - np.asarray(p.root_world)[:, None, None] for p in (first, second)]
    assert np.abs(root_relative[0] - root_relative[1]).max() > 1e-3


def test_content_of_masked_views_changes_nothing(model, make_scene):
    views, cams = make_scene(2, 4)
    cams = _mask(cams, [[0, 1, 1, 0], [1, 0, 1, 1]])
    hidden = ~cams.view_mask
    other = views.copy()
    other[hidden] = 77
    K, T = cams.K.copy(), cams.T_cam_from_world.copy()
    K[hidden], T[hidden] = np.nan, 0
    expected, found = model(views, cams), model(other, Cameras(K, T, cams.view_mask))
    np.testing.assert_array_equal(_points(found), _points(expected))


def test_padding_by_masked_views_changes_nothing(micro, make_scene):
    views, cams = make_scene(2, 4)
    shown = [1, 2]
    padded = micro(views, _mask(cams, [[0, 1, 1, 0]] * 2))
    alone = micro(*_take_views(views, cams, shown))
    np.testing.assert_allclose(_points(padded), _points(alone), atol=METRES)
    np.testing.assert_allclose(padded.keypoints_px[:, shown], alone.keypoints_px, atol=1e-3)


def test_other_views_are_a_set(model, make_scene):
    views, cams = make_scene(2, 4)
    turned = model(*_take_views(views, cams, [0, 2, 3, 1]))
    np.testing.assert_allclose(_points(turned), _points(model(views, cams)), atol=METRES)


def test_prediction_moves_with_the_world(model, make_scene):
    views, cams = make_scene(2, 4)
    cams = _mask(cams, [[1, 1, 1, 1], [0, 1, 1, 1]])
    T_new_from_old = rigid(rotation_from_axis_angle(np.array([0.3, -2.0, 1.0])), np.array([0.4, -0.2, 1.0]))
    T_cam_from_new = cams.T_cam_from_world @ np.linalg.inv(T_new_from_old)
    moved = model(views, cams._replace(T_cam_from_world=T_cam_from_new.astype(np.float32)))
    expected = transform_points(T_new_from_old, _points(model(views, cams)))
    np.testing.assert_allclose(_points(moved), expected, atol=METRES)


def test_other_samples_do_not_matter(model, make_scene):
    views, cams = make_scene(2, 4)
    other_views, other_cams = make_scene(2, 4, seed=1)
    mixed = np.stack([views[0], other_views[1]])
    mixed_cams = Cameras(*(np.stack([a[0], b[1]]) for a, b in zip(cams, other_cams, strict=True)))
    expected, found = model(views, cams), model(mixed, mixed_cams)
    np.testing.assert_allclose(_points(found)[0], _points(expected)[0], atol=METRES)
    assert np.abs(_points(found)[1] - _points(expected)[1]).max() > 1e-3


def test_permuted_basis_changes_nothing(micro_config, make_params, make_scene):
    """Features travel with their points, so the queries read the same."""
    params = make_params(micro_config)
    order = np.random.default_rng(0).permutation(micro_config.basis.num_points)
    points = params["constants"]["basis_points"][order]
    permuted = {**params, "constants": {**params["constants"], "basis_points": points}}
    expected, found = (apply(p, *make_scene(2, 4), config=micro_config) for p in (params, permuted))
    np.testing.assert_allclose(_points(found), _points(expected), atol=METRES)


def test_known_root_is_used_and_one_view_is_enough(micro, make_scene):
    views, cams = make_scene(2, 4)
    root = np.array([[0.01, -0.02, 0.03], [0.0, 0.0, 0.0]], np.float32)
    prediction = micro(views, _mask(cams, [[0, 0, 1, 0], [1, 1, 1, 1]]), root_world=root)
    assert prediction.valid.all()
    np.testing.assert_allclose(prediction.root_world, root, atol=1e-6)
    assert np.linalg.norm(_points(prediction) - root[:, None, None], axis=-1).max() < 2


def test_known_and_unknown_roots_mix(micro, make_scene):
    views, cams = make_scene(2, 4)
    mixed = _mask(cams, [[1, 0, 0, 0], [1, 1, 1, 1]])
    root = np.array([[0.01, -0.02, 0.03], [np.nan] * 3], np.float32)
    prediction = micro(views, mixed, root_world=root)
    assert prediction.valid.all()
    np.testing.assert_allclose(prediction.root_world[0], root[0], atol=1e-6)
    np.testing.assert_allclose(_points(prediction)[1], _points(micro(views, cams))[1], atol=METRES)


@pytest.mark.parametrize("known", [False, True])
def test_a_far_world_costs_no_precision(model, make_scene, known):
    """One kilometre away, where float32 steps by 0.06 mm; the last sum may round by half of that."""
    views, cams = make_scene(2, 4)
    cams = cams._replace(T_cam_from_world=cams.T_cam_from_world.astype(np.float64))
    root = np.array([[0.01, -0.02, 0.03], [np.nan] * 3]) if known else None
    shift = np.array([1000.3, -700.7, 123.4])
    T = cams.T_cam_from_world.copy()
    T[..., :3, 3] -= T[..., :3, :3] @ shift
    near = model(views, cams, root_world=root)
    far = model(views, cams._replace(T_cam_from_world=T), root_world=None if root is None else root + shift)
    for name in ("vertices_world", "joints_world", "root_world", "layers_world", "translation"):
        if getattr(near, name) is not None:
            found = np.asarray(getattr(far, name), np.float64) - shift
            np.testing.assert_allclose(found, getattr(near, name), atol=METRES + 3.1e-5, err_msg=name)


def test_too_far_worlds_are_refused(micro, make_scene):
    views, cams = make_scene(2, 4)
    T = cams.T_cam_from_world.astype(np.float64)
    T[..., :3, 3] -= T[..., :3, :3] @ np.array([448_000.0, 5_411_000.0, 300.0])
    with pytest.raises(ValueError, match=r"within 1678 m of the world's origin .*got 5\.411e\+06 m"):
        micro(views, cams._replace(T_cam_from_world=T))


def test_parametric_output_is_the_hand_model(parametric_config, make_params, make_scene):
    params = make_params(parametric_config)
    prediction = apply(params, *make_scene(2, 4), config=parametric_config)
    hand = HandModel(**params["constants"]["hand"])
    mesh = hand_mesh(hand, prediction.pose, prediction.shape, prediction.translation)
    np.testing.assert_allclose(mesh.vertices, prediction.vertices_world, atol=METRES)
    np.testing.assert_allclose(mesh.joints, prediction.joints_world, atol=METRES)
    np.testing.assert_allclose(prediction.joints_world[:, 9], prediction.root_world, atol=METRES)


def test_new_view_masks_compile_nothing(micro, make_scene):
    views, cams = make_scene(2, 4)
    micro(views, cams)
    programs = _predict._cache_size()
    for mask in ([[1, 1, 0, 1], [0, 1, 1, 0]], [[0, 0, 1, 1], [1, 1, 1, 1]]):
        micro(views, cams._replace(view_mask=np.array(mask, bool)))
    assert _predict._cache_size() == programs


def test_unsolvable_samples_under_a_trace_are_flagged_and_finite(micro, make_scene):
    views, cams = make_scene(2, 4)
    traced = jax.jit(micro)
    K = cams.K.copy()
    K[0, 1, 0, 0] = np.nan
    for cameras, valid in (
        (_mask(cams, [[1, 1, 1, 1], [0, 0, 0, 0]]), [True, False]),
        (_mask(cams, [[0, 1, 0, 0], [0, 1, 1, 0]]), [False, True]),
        (cams._replace(K=K), [False, True]),
    ):
        prediction = traced(views, cameras)
        np.testing.assert_array_equal(prediction.valid, valid)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(prediction))


def test_float_images_equal_bytes(micro, make_scene):
    views, cams = make_scene(2, 4)
    as_float = micro(views.astype(np.float32) / 255, cams)
    np.testing.assert_allclose(_points(as_float), _points(micro(views, cams)), atol=1e-6)


def test_vmap_and_pmap(micro, make_scene):
    views, cams = make_scene(2, 4)
    expected = _points(micro(views, cams))
    device_and_lane = jax.tree.map(lambda x: x[:, None, None], (views, cams))
    prediction = jax.pmap(jax.vmap(micro))(*device_and_lane)
    found = np.asarray(prediction.layers_world)[:, 0, 0]
    np.testing.assert_allclose(found, expected, atol=METRES)


@pytest.fixture
def loss64(joints_config, make_params, make_scene):
    """Return a float64 loss of cameras and root, and its inputs; needs x64.

    One sample knows its root, the other triangulates it; both triangulate the joints that pose the template.
    """

    def make():
        params = as_float64(make_params(joints_config))
        views, cams = make_scene(2, 3)

        def loss(K, T, root):
            cameras = Cameras(K, T, cams.view_mask)
            prediction, _ = forward(params, views, cameras, config=joints_config, root_world=root)
            return jnp.sum(jnp.sin(30 * prediction.layers_world))

        inputs = [
            as_float64(jnp.asarray(x))
            for x in (cams.K, cams.T_cam_from_world, np.array([[0.01] * 3, [np.nan] * 3]))
        ]
        return jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2))), inputs

    return make


@pytest.mark.slow
def test_gradients_of_cameras_and_root_match_finite_differences(loss64):
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        loss_and_gradients, inputs = loss64()
        _, gradients = loss_and_gradients(*inputs)
        for n, scale in enumerate((1e-4, 1e-7, 1e-7)):
            step = scale * rng.normal(size=inputs[n].shape)
            if n < 2:
                step[..., -1, :] = 0
            plus, minus = (
                loss_and_gradients(*(x + sign * step if i == n else x for i, x in enumerate(inputs)))[0]
                for sign in (1, -1)
            )
            assert np.isfinite(gradients[n]).all()
            np.testing.assert_allclose((plus - minus) / 2, jnp.sum(gradients[n] * step), rtol=5e-4)


@pytest.mark.slow
def test_gradients_through_apply_match_finite_differences(micro_config, make_params, make_scene):
    """The whole `Cameras` with `allow_int`, or its two arrays."""
    views, cams = make_scene(1, 3)
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        params = as_float64(make_params(micro_config))
        cams = as_float64(cams)

        def loss(cams):
            prediction = apply(params, views, cams, config=micro_config)
            return jnp.sum(jnp.sin(30 * prediction.vertices_world))

        with pytest.raises(TypeError, match="allow_int"):
            jax.grad(loss)(cams)
        gradient = jax.grad(loss, allow_int=True)(cams)
        assert gradient.view_mask.dtype == jax.dtypes.float0
        arrays = jax.grad(lambda K, T: loss(Cameras(K, T, cams.view_mask)), argnums=(0, 1))(*cams[:2])
        steps = {"K": 1e-4 * rng.normal(size=cams.K.shape) * [[1, 1, 1], [0, 1, 1], [0, 0, 0]]}
        twists = np.zeros((*cams.K.shape[:2], 4, 4))
        twists[..., :3, :3] = skew_matrix(1e-7 * rng.normal(size=(1, 3, 3)))
        twists[..., :3, 3] = 1e-7 * rng.normal(size=(1, 3, 3))
        steps["T_cam_from_world"] = cams.T_cam_from_world @ twists
        for (name, step), alone in zip(steps.items(), arrays, strict=True):
            plus, minus = (
                loss(cams._replace(**{name: getattr(cams, name) + sign * step})) for sign in (1, -1)
            )
            found = jnp.sum(getattr(gradient, name) * step)
            np.testing.assert_allclose((plus - minus) / 2, found, rtol=5e-4, err_msg=name)
            np.testing.assert_allclose(alone, getattr(gradient, name), rtol=1e-9)


@pytest.mark.slow
def test_params_have_gradients(parametric_config, make_scene):
    """Indices and flags are among the parameters of `init`, and not among what is differentiated."""
    params, scene = init(parametric_config, key=jax.random.key(0)), make_scene(2, 4)
    gradient = jax.grad(lambda p: apply(p, *scene, config=parametric_config).vertices_world.sum())(params)
    assert jax.tree.structure(gradient) == jax.tree.structure(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    np.testing.assert_array_equal(gradient["constants"]["hand"]["faces"], default_hand().faces)


def test_fresh_weights_have_their_distributions(hrnet_config):
    params = init(replace(hrnet_config, width=64), key=jax.random.key(0))
    weights = params["trainable"]
    conv = weights["features"]["branch"]["merges"]["0"]
    kernel = np.asarray(conv["conv"]["kernel"])
    np.testing.assert_allclose(kernel.std(), np.sqrt(2 / np.prod(kernel.shape[:-1])), rtol=0.1)
    linear = np.asarray(weights["decoder"]["layers"]["0"]["vector_attention"]["alpha"]["kernel"])
    limit = np.sqrt(6 / sum(linear.shape))
    np.testing.assert_allclose(linear.std(), limit / np.sqrt(3), rtol=0.05)
    assert np.abs(linear).max() <= limit
    assert abs(linear.mean()) < 0.05 * limit
    other = init(replace(hrnet_config, width=64), key=jax.random.key(1))
    assert not np.allclose(other["trainable"]["decoder"]["embeddings"], weights["decoder"]["embeddings"])


def test_training_moves_statistics_and_every_weight_has_a_gradient(joints_config, make_params, make_scene):
    params = make_params(joints_config)
    views, cams = make_scene(2, 2)

    def loss(trainable):
        prediction, statistics = forward(
            {**params, "trainable": trainable}, views, cams, config=joints_config, train=True
        )
        return jnp.sum(prediction.layers_world**2) + jnp.sum(prediction.keypoints_px), statistics

    gradients, statistics = jax.jit(jax.grad(loss, has_aux=True))(params["trainable"])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    dead = [p for p, leaf in jax.tree_util.tree_leaves_with_path(gradients) if not np.any(leaf)]
    assert not dead
    assert jax.tree.structure(statistics) == jax.tree.structure(params["statistics"])
    moved = jax.tree.map(lambda a, b: not np.allclose(a, b), statistics, params["statistics"])
    assert all(jax.tree.leaves(moved))


def test_inference_leaves_statistics_alone(micro_config, make_params, make_scene):
    params = make_params(micro_config)

    def statistics():
        return forward(params, *make_scene(1, 2), config=micro_config)[1]

    assert jax.eval_shape(statistics).keys() == params["statistics"].keys()


def test_fresh_params_start_at_the_template(micro_config, make_scene):
    params = init(micro_config, key=jax.random.key(0))
    shapes, expected = (
        {name: (leaf.shape, leaf.dtype) for name, leaf in leaves_with_names(tree).items()}
        for tree in (params, describe(micro_config))
    )
    assert shapes == expected
    prediction = apply(params, *make_scene(2, 4), config=micro_config)
    lengths = np.linalg.norm(prediction.vertices_world - prediction.root_world[:, None], axis=-1)
    template = np.linalg.norm(params["constants"]["template_queries"][:778], axis=-1)
    np.testing.assert_allclose(lengths, np.stack([template] * 2), atol=METRES)


def test_other_views_are_a_set_exactly_in_float64(joints_config, make_params, make_scene):
    """Without float32's rounding no neighbour changes, and the law holds for every point."""
    views, cams = make_scene(2, 4)
    order = np.array([0, 2, 3, 1])
    with jax.enable_x64(True):
        params = as_float64(make_params(joints_config))
        cams = as_float64(cams)
        run = jax.jit(lambda v, c: forward(params, v, c, config=joints_config)[0].layers_world)
        turned = run(jnp.asarray(views)[:, order], Cameras(*(x[:, order] for x in cams)))
        np.testing.assert_allclose(turned, run(jnp.asarray(views), cams), atol=1e-8)
