"""Bad input: every message says what, expected, got."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from poem_jax.geometry.cameras import Cameras
from poem_jax.models.apply import apply, check_inputs
from poem_jax.models.infer import infer, prepare
from poem_jax.models.network import check_params


@pytest.fixture
def check(micro_config, make_scene):
    """Check inputs that a test may change first."""

    def run(change=lambda views, cams: (views, cams), views=3, root_world=None):
        check_inputs(*change(*make_scene(2, views)), root_world, micro_config)

    return run


def test_good_inputs_pass(check):
    check()
    check(lambda v, c: (v.astype(np.float32) / 255, c))
    check(views=1, root_world=np.zeros((2, 3), np.float32))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda v, c: (v[0], c),
            r"`views` must have shape \(batch, view, \*\(32, 32\), 3\); got \(3, 32, 32, 3\)",
        ),
        (lambda v, c: (v[:, :, :16], c), r"`views` must .*; got \(2, 3, 16, 32, 3\).*crop_intrinsics"),
        (lambda v, c: (v.astype(np.int32), c), r"`views` must be uint8, or float in \[0, 1\]; got int32"),
        (lambda v, c: (v.astype(np.float32), c), r"float `views` must be in \[0, 1\]; .* Divide by 255"),
        (lambda v, c: (np.full(v.shape, np.nan, np.float32), c), "`views` must be finite"),
        (lambda v, c: (v.tolist(), c), r"`views` must be a NumPy or JAX array; got list.*numpy.asarray"),
        (lambda v, c: (v, tuple(c)), r"`cams` must be `Cameras\(.*; got tuple"),
        (lambda v, c: (v, Cameras(c.K.tolist(), c[1], c[2])), r"`cams.K` must be .* array; got list"),
        (lambda v, c: (v, Cameras(c.K.tolist(), c[1])), r"`cams.K` must be .* array; got list"),
        (lambda v, c: (v, c._replace(view_mask=c[2].tolist())), r"`cams.view_mask` must be .*; got list"),
        (
            lambda v, c: (v[:0], Cameras(*(x[:0] for x in c))),
            r"at least one sample .*; got .*\(0, 3",
        ),
        (lambda v, c: (v[:, :0], Cameras(*(x[:, :0] for x in c))), r"at least one sample .*\(2, 0, 32"),
        (lambda v, c: (v[:, :2], c), r"`cams.K` must have shape .* = \(2, 2, 3, 3\).*got \(2, 3, 3, 3\)"),
        (lambda v, c: (v, c._replace(view_mask=c.view_mask.astype(int))), "`view_mask` must be bool"),
        (lambda v, c: (v, c._replace(view_mask=c.view_mask & False)), r"samples \[0, 1\] is all False"),
        (lambda v, c: (v, c._replace(K=c.K * np.nan)), "`K` must be finite"),
        (lambda v, c: (v, c._replace(T_cam_from_world=2 * c.T_cam_from_world)), "`T_cam_from_world`"),
    ],
)
def test_wrong_inputs(check, change, message):
    with pytest.raises(ValueError, match=message):
        check(change)


def test_one_view_needs_a_root(check):
    with pytest.raises(ValueError, match=r"one valid view needs `root_world`.*samples \[0, 1\]"):
        check(views=1)


def test_roots_may_be_unknown_where_two_views_see_them(check):
    def mixed(views, cams):
        return views, cams._replace(view_mask=np.array([[1, 0, 0], [1, 1, 1]], bool))

    nan = [np.nan] * 3
    check(mixed, root_world=np.array([[0, 0, 0], nan], np.float32))
    check(root_world=np.array([nan, nan], np.float32))
    with pytest.raises(
        ValueError, match=r"one valid view needs `root_world`.*samples \[0\] have one, and no"
    ):
        check(mixed, root_world=np.array([nan, [0, 0, 0]], np.float32))


@pytest.mark.parametrize("row", [[np.nan, 0, 0], [np.inf, 0, 0]])
def test_roots_are_finite_or_unknown(check, row):
    with pytest.raises(ValueError, match=r"`root_world` must be finite, or NaN in all.*samples \[1\]"):
        check(root_world=np.array([[0, 0, 0], row], np.float32))


def test_unknown_roots_leave_the_test_of_resolution_as_it_is(check):
    """K of another resolution is noticed with no root, and so it is with an unknown one."""

    def halved(views, cams):
        return views, cams._replace(K=cams.K * np.array([6, 6, 1], np.float32)[:, None])

    nan = np.full((2, 3), np.nan, np.float32)
    for root in (None, nan):
        with pytest.raises(ValueError, match="`K` must belong to the image as fed"):
            check(halved, root_world=root)


def test_root_must_be_an_array(check):
    with pytest.raises(ValueError, match="`root_world` must be a NumPy or JAX array; got list"):
        check(root_world=[[0.0] * 3] * 2)


def test_root_must_fit_the_batch(check):
    with pytest.raises(ValueError, match="`root_world` must have shape"):
        check(root_world=np.zeros((5, 3), np.float32))


def test_apply_checks_its_inputs(micro_config, make_params, make_scene):
    views, cams = make_scene(2, 3)
    with pytest.raises(ValueError, match="`K` must be finite"):
        apply(make_params(micro_config), views, cams._replace(K=cams.K * np.nan), config=micro_config)


def test_params_of_another_config(micro_config, make_params, make_scene):
    message = r"`params` do not belong to `config`: .* entries differ, the first are .*expected .*, got .*"
    with pytest.raises(ValueError, match=message):
        apply(make_params(micro_config), *make_scene(2, 3), config=replace(micro_config, width=32))
    with pytest.raises(ValueError, match=message):
        check_params(micro_config, {"trainable": {}})


@pytest.fixture(params=["apply", "infer"])
def eager(request, micro_config, make_params):
    params = make_params(micro_config)
    if request.param == "apply":
        return functools.partial(apply, params, config=micro_config)
    return functools.partial(infer, prepare(params, micro_config))


def test_one_camera_given_several_times_does_not_fix_the_hand(eager, make_scene):
    """The second sample is good."""
    views, cams = make_scene(2, 3)
    T = cams.T_cam_from_world.copy()
    T[0, 1:] = T[0, 0]
    with pytest.raises(ValueError, match=r"cameras at one place .* in samples \[0\] .*or `root_world`"):
        eager(views, cams._replace(T_cam_from_world=T))


def test_parallel_rays_do_not_fix_the_hand(eager, make_scene):
    """The same image seen by the same camera, moved sideways."""
    views, cams = make_scene(2, 3)
    K, T, views = cams.K.copy(), cams.T_cam_from_world.copy(), views.copy()
    views[0], K[0], T[0] = views[0, 0], K[0, 0], T[0, 0]
    T[0, :, 0, 3] += [0.0, 0.1, -0.1]
    with pytest.raises(ValueError, match=r"different directions .* samples \[0\] all rays .* are parallel"):
        eager(views, cams._replace(K=K, T_cam_from_world=T))
    root = np.array([[0.0, 0.0, 0.0], [np.nan] * 3], np.float32)
    assert eager(views, cams._replace(K=K, T_cam_from_world=T), root_world=root).valid.all()
