from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.cameras import pixel_centres
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.render.soft import (
    BLUR_SIGMAS,
    MIN_AREA,
    RELEASE_BLUR_RADIUS,
    RELEASE_SIGMA,
    soft_coverage,
    soft_silhouette,
)
from poem_jax.render.zbuffer import NO_FACE, rasterise

draw = jax.jit(soft_silhouette, static_argnames="hw")


def segment_distance(p, a, b):
    t = np.clip((p - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0, 1)
    return np.sum((p - a - t * (b - a)) ** 2)


def signed_distance(p, corners):
    """Squared distance to a triangle's outline, negative inside."""
    distance = min(segment_distance(p, corners[k], corners[k - 1]) for k in range(3))
    weights = np.linalg.solve(np.vstack([corners.T, np.ones(3)]), [*p, 1])
    return -distance if weights.min() >= 0 else distance


def naive(uv_px, faces, hw, sigma, blur_radius):
    """One pixel and one face at a time, straight from the definition."""
    ndc = (2 * uv_px - [hw[1], hw[0]]) / min(hw)
    clear = np.ones(hw)
    for i, j in np.ndindex(*hw):
        p = (2 * np.array([j + 0.5, i + 0.5]) - [hw[1], hw[0]]) / min(hw)
        for corners in ndc[faces]:
            (e, f) = corners[1] - corners[0], corners[2] - corners[0]
            if abs(e[0] * f[1] - e[1] * f[0]) <= MIN_AREA:
                continue
            d = signed_distance(p, corners)
            if d < blur_radius:
                clear[i, j] *= 1 - 1 / (1 + np.exp(d / sigma))
    return 1 - clear


def all_faces(uv_px, faces, hw, sigma):
    """Every face at every pixel at once, as plain differentiable JAX."""
    corners = ((2 * uv_px - jnp.array([hw[1], hw[0]])) / min(hw))[faces]
    pixels = (2 * pixel_centres(hw, np.float64) - np.array([hw[1], hw[0]])) / min(hw)
    p = pixels[:, :, None, None]
    a, e = corners, jnp.roll(corners, -1, axis=1) - corners
    t = jnp.clip(((p - a) * e).sum(-1) / (e * e).sum(-1), 0, 1)
    distance = ((p - a - t[..., None] * e) ** 2).sum(-1).min(-1)
    side = e[..., 0] * (p - a)[..., 1] - e[..., 1] * (p - a)[..., 0]
    inside = (side >= 0).all(-1) | (side <= 0).all(-1)
    return 1 - jnp.prod(jax.nn.sigmoid(jnp.where(inside, -distance, distance) / sigma), axis=-1)


def random_scene(seed, hw=(19, 26), num_faces=12):
    rng = np.random.default_rng(seed)
    centres = rng.uniform([0, 0], [hw[1], hw[0]], (num_faces, 1, 2))
    uv_px = (centres + rng.normal(0, 4, (num_faces, 3, 2))).reshape(-1, 2)
    return uv_px, np.arange(3 * num_faces, dtype=np.int32).reshape(-1, 3)


def hand_view(turn=(0.3, 0.2, 0.1), focal=420.0, dtype=np.float32):
    """The shipped hand's pixels and depths in a 128 px image."""
    pose = np.zeros((16, 3), np.float32)
    pose[0] = turn
    pose[1:, 2] = 0.3
    vertices = hand_mesh(default_hand(), pose, np.zeros(10, np.float32)).vertices
    vertices = vertices[:, [0, 2, 1]] - vertices[:, [0, 2, 1]].mean(0) + np.array([0, 0, 0.5])
    uv_px = focal * vertices[:, :2] / vertices[:, 2:] + 64
    return uv_px.astype(dtype), vertices[:, 2].astype(dtype), default_hand().faces


@pytest.mark.parametrize("hw", [(19, 26), (24, 3)])
def test_agrees_with_the_definition(hw):
    sigma = 1e-2
    uv_px, faces = random_scene(0, hw)
    radius = 9.0 * sigma
    with jax.enable_x64(True):
        got = draw(uv_px, np.ones(len(uv_px)), faces, hw, sigma=sigma, blur_radius=radius)
        assert got.dtype == np.float64
    np.testing.assert_allclose(got, naive(uv_px, faces, hw, sigma, radius), atol=1e-12)


def test_pairing_loses_nothing():
    """Value and gradient of every face at every pixel, within what the default blur radius leaves out."""
    hw = (40, 52)
    uv_px, faces = random_scene(1, hw, 30)
    depth, weights = np.ones(len(uv_px)), np.random.default_rng(2).normal(size=hw)

    @jax.jit
    @partial(jax.grad, has_aux=True)
    def tiled(uv, sigma):
        image = soft_silhouette(uv, depth, faces, hw, sigma=sigma, blur_radius=35 * sigma)
        return (image * weights).sum(), image

    @jax.jit
    @partial(jax.grad, has_aux=True)
    def plain(uv, sigma):
        image = all_faces(uv, faces, hw, sigma)
        return (image * weights).sum(), image

    with jax.enable_x64(True):
        for sigma in (1e-4, 1e-3, 1e-1):
            got, image = tiled(uv_px, sigma)
            want, reference = plain(uv_px, sigma)
            short = draw(uv_px, depth, faces, hw, sigma=sigma)
            np.testing.assert_allclose(image, reference, atol=1e-11)
            np.testing.assert_allclose(got, want, atol=1e-9 * np.abs(want).max())
            np.testing.assert_allclose(short, reference, atol=len(faces) * np.exp(-BLUR_SIGMAS))


def test_gradient_of_the_hand_against_finite_differences():
    """128 px, all 1538 faces, float64, along random directions of all vertices."""
    hw, step = (128, 128), 1e-6
    uv_px, depth, faces = hand_view(dtype=np.float64)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=hw)

    def value(uv, sigma):
        image = soft_silhouette(uv, jnp.asarray(depth), faces, hw, sigma=sigma, blur_radius=40 * sigma)
        return (image * weights).sum()

    with jax.enable_x64(True):
        both = jax.jit(jax.value_and_grad(value))
        for sigma in (1e-4, 1e-3):
            gradient = both(uv_px, sigma)[1]
            for _ in range(3):
                along = rng.normal(size=uv_px.shape)
                rise = both(uv_px + step * along, sigma)[0] - both(uv_px - step * along, sigma)[0]
                np.testing.assert_allclose((gradient * along).sum(), rise / (2 * step), rtol=1e-5)


@pytest.mark.parametrize("turn", [(0.3, 0.2, 0.1), (1.2, 0.5, -0.4), (-0.8, -0.3, 0.9)])
def test_hard_limit_is_the_silhouette_of_the_z_buffer(turn):
    uv_px, depth, faces = hand_view(turn)
    hw = (128, 128)
    hard = rasterise(np.column_stack([uv_px, depth]), faces, hw).face_index != NO_FACE
    soft = draw(uv_px, depth, faces, hw, sigma=RELEASE_SIGMA, blur_radius=RELEASE_BLUR_RADIUS)
    alpha = np.asarray(soft)
    assert hard.mean() > 0.05
    assert (hard & (alpha > 0.5)).sum() / (hard | (alpha > 0.5)).sum() > 0.98
    assert np.abs(alpha - hard).mean() < 0.02
    assert alpha[hard].min() >= 0.5 - 1e-3


def test_one_face_of_known_distances():
    """At 128 px a pixel is 1 / 64 of NDC: one pixel outside a long edge, d = 2^-12."""
    uv_px = np.array([[-500.0, 64.5], [600.0, 64.5], [64.5, 900.0]])
    image = draw(uv_px, np.ones(3), np.array([[0, 1, 2]]), (128, 128), sigma=2.0**-12)
    column = np.asarray(image)[:, 64]
    expected = 1 / (1 + np.exp([4.0, 1.0, 0.0, -1.0, -4.0]))
    np.testing.assert_allclose(column[62:67], expected, rtol=1e-5)
    assert column[0] == 0


def test_order_of_faces_and_corners_does_not_matter():
    uv_px, depth, faces = hand_view()
    rng = np.random.default_rng(0)
    mixed = np.roll(rng.permutation(faces), 1, axis=1)[:, ::-1]
    cover = jax.jit(lambda faces: soft_coverage(uv_px, depth, faces, (128, 128)))
    np.testing.assert_allclose(cover(faces), cover(mixed), rtol=2e-4, atol=2e-5)


def test_faces_hidden_behind_others_count():
    """A repeated face squares the clearness, wherever it stands in depth; the hard limit does not change."""
    uv_px, faces = random_scene(3)
    depth = np.ones(len(uv_px))
    doubled = np.concatenate([faces, faces + len(uv_px)])
    two = np.concatenate([uv_px, uv_px]), np.concatenate([depth, depth + 1])
    cover = jax.jit(partial(soft_coverage, hw=(19, 26), sigma=1e-2))
    one, both = cover(*two, np.where(doubled < len(uv_px), doubled, 0)), cover(*two, doubled)
    np.testing.assert_allclose(both, 2 * one, rtol=1e-5)


def test_moving_the_mesh_by_whole_pixels_moves_the_image():
    uv_px, faces = random_scene(4, (12, 12))
    ones = np.ones(len(uv_px))
    here = draw(uv_px + 10, ones, faces, (40, 40), sigma=1e-3)
    there = draw(uv_px + np.array([15, 13]), ones, faces, (40, 40), sigma=1e-3)
    np.testing.assert_allclose(here[5:30, 5:30], there[8:33, 10:35], atol=1e-5)


def test_batch_axes_and_vmap():
    batch, faces = (3, 2), random_scene(5)[1]

    def loss(uv, z):
        return (soft_silhouette(uv, z, faces, (19, 26), sigma=1e-3) ** 2).sum((-2, -1))

    single = jax.jit(jax.value_and_grad(loss))
    uv_px = random_scene(5)[0]
    many = jnp.asarray(uv_px + np.random.default_rng(0).normal(0, 2, (*batch, *uv_px.shape)), jnp.float32)
    depth = jnp.ones(many.shape[:-1])
    each = [single(many[index], depth[index]) for index in np.ndindex(*batch)]
    values = np.reshape(np.array([value for value, _ in each]), batch)
    gradients = np.reshape(np.array([gradient for _, gradient in each]), many.shape)

    np.testing.assert_allclose(jax.jit(loss)(many, depth), values, rtol=1e-4)
    mapped = jax.jit(jax.vmap(jax.value_and_grad(lambda uv, z: loss(uv, z).sum())))(many, depth)
    np.testing.assert_allclose(mapped[0], values.sum(1), rtol=1e-4)
    np.testing.assert_allclose(mapped[1], gradients, rtol=1e-3, atol=1e-3)


@partial(jax.jit, static_argnames="hw")
@partial(jax.grad, has_aux=True)
def slope_and_image(uv, depth, faces, hw, sigma):
    image = soft_silhouette(uv, depth, faces, hw, sigma=sigma)
    return image.sum(), image


def value_and_gradient(uv_px, depth, faces, hw=(16, 16), sigma=1e-3):
    gradient, image = slope_and_image(np.float32(uv_px), np.float32(depth), np.int32(faces), hw, sigma)
    return np.asarray(image), np.asarray(gradient)


def test_faces_that_do_not_count():
    """Without area, behind the camera, not finite, absurdly far, outside the image: nothing, no slope."""
    good = np.array([[3.0, 3], [12, 4], [7, 13]])
    bad = np.array(
        [[5.0, 5], [8, 8], [11, 11], [5, 5], [np.nan, 2], [np.inf, 3], [1e12, 3], [9, 1], [500, 9]]
    )
    uv_px = np.concatenate([good, bad])
    depth = np.ones(len(uv_px))
    depth[10] = -0.2
    junk = [[3, 4, 5], [3, 6, 4], [3, 3, 3], [7, 4, 0], [8, 4, 0], [9, 4, 0], [10, 0, 1], [11, 11, 11]]
    image, gradient = value_and_gradient(uv_px, depth, [*junk, [0, 1, 2]])
    padded = np.concatenate([good, np.zeros_like(bad)])
    want, want_gradient = value_and_gradient(padded, np.ones(len(padded)), [*[[0, 0, 0]] * 8, [0, 1, 2]])
    np.testing.assert_array_equal(image, want)
    np.testing.assert_allclose(gradient, want_gradient, rtol=1e-5)
    assert want.max() > 0.9
    assert (gradient[3:] == 0).all()
    nothing, flat = value_and_gradient(uv_px, np.full(len(uv_px), np.nan), [*junk, [0, 1, 2]])
    assert (nothing == 0).all()
    assert (flat == 0).all()


@pytest.mark.parametrize("sigma", [1e-8, 1e-6, 1e-4, 1.0])
def test_pixels_exactly_on_corners_and_edges_are_finite(sigma):
    uv_px = np.array([[2.5, 2.5], [10.5, 2.5], [2.5, 10.5], [2.5 + 1e-6, 2.5]])
    faces = [[0, 1, 2], [0, 2, 1], [0, 3, 2], [1, 2, 3]]
    image, gradient = value_and_gradient(uv_px, np.ones(4), faces, sigma=sigma)
    assert np.isfinite(image).all()
    assert np.isfinite(gradient).all()
    assert ((image >= 0) & (image <= 1)).all()


def test_a_face_larger_than_the_image_covers_it():
    uv_px = np.array([[-1e4, -1e4], [3e4, -1e4], [-1e4, 3e4]])
    image, gradient = value_and_gradient(uv_px, np.ones(3), [[0, 1, 2]], hw=(37, 50))
    np.testing.assert_array_equal(image, np.ones((37, 50)))
    assert np.isfinite(gradient).all()


def test_softness_may_be_traced_and_has_no_slope():
    uv_px, faces = random_scene(6)
    ones = np.ones(len(uv_px))
    fixed = jax.jit(lambda uv: soft_silhouette(uv, ones, faces, (19, 26), sigma=1e-3).sum())(uv_px)
    traced = jax.jit(
        jax.value_and_grad(lambda sigma: soft_silhouette(uv_px, ones, faces, (19, 26), sigma=sigma).sum())
    )
    value, slope = traced(1e-3)
    np.testing.assert_allclose(value, fixed, rtol=1e-5)
    assert slope == 0


def test_bad_shapes_are_refused():
    uv_px, faces = random_scene(0)
    with pytest.raises(ValueError, match=r"`hw` must be positive; got \(0, 4\)"):
        soft_silhouette(uv_px, np.ones(len(uv_px)), faces, (0, 4))
