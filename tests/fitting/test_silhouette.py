import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from poem_jax.fitting.silhouette import (
    LOG_FLOOR,
    silhouette_cross_entropy,
    silhouette_l1,
    silhouette_residuals,
    view_coverage,
)
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.render.zbuffer import NO_FACE, rasterise

IMAGE_HW = (256, 256)
MASK_HW = (64, 64)
FACES = default_hand().faces
LOSSES = pytest.mark.parametrize("loss", [np.array([1.0, 0.0]), np.array([0.0, 1.0])], ids=["l1", "entropy"])


@pytest.fixture(scope="module")
def hand():
    """Vertices about the world's origin, metres."""
    pose = np.zeros((16, 3), np.float32)
    pose[1:, 2] = 0.3
    vertices = hand_mesh(default_hand(), pose, np.zeros(10, np.float32)).vertices
    return (vertices - vertices.mean(0)).astype(np.float32)


@pytest.fixture(scope="module")
def cams():
    """Four cameras around the origin, 0.5 m away."""
    turns = rotation_from_axis_angle(
        np.array([[1.4, 0, 0], [-1.2, 0.6, 0], [1.0, 0.9, 0.5], [0.2, 0.3, 1.5]], np.float32)
    )
    T_cam_from_world = np.tile(np.eye(4, dtype=np.float32), (4, 1, 1))
    T_cam_from_world[:, :3, :3] = turns
    T_cam_from_world[:, 2, 3] = 0.5
    K = np.array([[500, 0, 130], [0, 480, 126], [0, 0, 1]], np.float32)
    return Cameras(np.tile(K, (4, 1, 1)), T_cam_from_world)


@pytest.fixture(scope="module")
def masks(hand, cams):
    """What the z-buffer sees, at the masks' size."""
    scale = np.diag([MASK_HW[1] / IMAGE_HW[1], MASK_HW[0] / IMAGE_HW[0], 1])
    uv_px, depth = project(scale @ cams.K, cams.T_cam_from_world, hand)
    points = np.concatenate([uv_px, depth[..., None]], axis=-1)
    return np.stack([rasterise(view, FACES, MASK_HW).face_index != NO_FACE for view in points])


def loss_of(vertices, cams, masks, loss, sigma):
    """`loss` weighs the two losses, so that one compiled function serves the tests of both."""
    coverage = view_coverage(vertices, FACES, cams, IMAGE_HW, MASK_HW, sigma=sigma, blur_radius=50 * sigma)
    return sum(
        weight * term(coverage, masks, cams.view_mask)
        for weight, term in zip(loss, (silhouette_l1, silhouette_cross_entropy), strict=True)
    )


value_and_slope = jax.jit(jax.value_and_grad(loss_of))


def test_agrees_with_the_z_buffer_in_every_view(hand, cams, masks):
    coverage = jax.jit(lambda hand: view_coverage(hand, FACES, cams, IMAGE_HW, MASK_HW))(hand)
    seen = np.asarray(-np.expm1(-np.asarray(coverage)) > 0.5)
    overlap = (seen & masks).sum((-2, -1)) / (seen | masks).sum((-2, -1))
    assert masks.mean((-2, -1)).min() > 0.03
    assert overlap.min() > 0.98
    assert float(silhouette_l1(coverage, masks, cams.view_mask)) < 0.01


def test_terms_against_their_definitions():
    rng = np.random.default_rng(0)
    alpha = rng.uniform(0.01, 0.99, (2, 3, 4, 5))
    masks = rng.uniform(0, 1, alpha.shape)
    coverage = jnp.asarray(-np.log(1 - alpha), jnp.float32)
    view_mask = np.array([[True, False, True], [True, True, True]])
    entropy = -masks * np.log(alpha) - (1 - masks) * np.log(1 - alpha)
    for values, loss in ((np.abs(alpha - masks), silhouette_l1), (entropy, silhouette_cross_entropy)):
        want = [values[0, [0, 2]].mean(), values[1].mean()]
        np.testing.assert_allclose(loss(coverage, masks, view_mask), want, rtol=1e-5)
    residuals = silhouette_residuals(coverage, masks, view_mask)
    np.testing.assert_allclose(residuals, (alpha - masks) * view_mask[..., None, None], atol=1e-6)


def test_cross_entropy_is_zero_at_the_truth_and_bounded_far_from_it():
    coverage = jnp.asarray([[[0.0, 200.0], [0.0, 200.0]]])
    view_mask = np.array([True])
    right = np.array([[[0, 1], [0, 1]]])
    entropy = jax.jit(jax.value_and_grad(silhouette_cross_entropy))
    assert entropy(coverage, right, view_mask)[0] == 0
    value, slope = entropy(coverage, 1 - right, view_mask)
    assert value == -LOG_FLOOR
    assert (slope == 0).all()


@LOSSES
def test_lower_at_the_truth_than_beside_it(loss, hand, cams, masks):
    def value(vertices):
        return value_and_slope(np.float32(vertices), cams, np.float32(masks), np.float32(loss), 1e-4)[0]

    true = value(hand)
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(8, 3)):
        offset = 0.006 * direction / np.linalg.norm(direction)
        assert value(hand + offset) > 1.1 * true
    assert value(1.08 * hand) > true
    assert value(0.92 * hand) > true


@LOSSES
def test_gradient_pulls_a_displaced_hand_back(loss, hand, cams, masks):
    start = np.array([0.006, -0.005, 0.004], np.float32)
    steps = 60
    optimizer = optax.adam(optax.cosine_decay_schedule(1e-3, steps))
    advance = jax.jit(optimizer.update)
    offset, state = start, optimizer.init(start)
    for i in range(steps):
        slope = value_and_slope(hand + offset, cams, np.float32(masks), np.float32(loss), 1e-5)[1].sum(0)
        assert i > 0 or slope @ start > 0
        update, state = advance(slope, state)
        offset = np.float32(offset + update)
    # The soft silhouette is a little wider than the mask, so the minimum is not exactly the truth.
    assert np.linalg.norm(offset) < 0.1 * np.linalg.norm(start)


@LOSSES
def test_gradient_against_finite_differences(loss, hand, cams, masks):
    # A longer step would carry slivers seen edge-on across the area below which faces do not count.
    step = 2e-9
    rng = np.random.default_rng(0)
    wide = Cameras(cams.K.astype(np.float64), cams.T_cam_from_world.astype(np.float64))
    vertices = hand.astype(np.float64) + 0.003
    seen = rng.uniform(0.1, 0.9, masks.shape)
    with jax.enable_x64(True):
        gradient = value_and_slope(vertices, wide, seen, loss, 1e-4)[1]
        for _ in range(3):
            along = step * rng.normal(size=hand.shape)
            ends = [value_and_slope(vertices + sign * along, wide, seen, loss, 1e-4)[0] for sign in (1, -1)]
            np.testing.assert_allclose((gradient * along).sum(), (ends[0] - ends[1]) / 2, rtol=1e-4)


@LOSSES
def test_masked_views_change_nothing(loss, hand, cams, masks):
    """Neither what their cameras nor what their masks hold, NaN included."""
    loss, first, seen = np.float32(loss), np.array([True, True, False, False]), np.float32(masks)
    expected = value_and_slope(hand, cams._replace(view_mask=first), seen, loss, 1e-4)
    for junk in (0.0, np.nan):
        K, T, seen = cams.K.copy(), cams.T_cam_from_world.copy(), seen.copy()
        K[2:], T[2:], seen[2:] = junk, junk, junk
        value, slope = value_and_slope(hand, Cameras(K, T, first), seen, loss, 1e-4)
        np.testing.assert_allclose(value, expected[0], rtol=1e-6)
        np.testing.assert_allclose(slope, expected[1], rtol=1e-5, atol=1e-6 * np.abs(expected[1]).max())
    value, slope = value_and_slope(hand, Cameras(K, T, np.zeros(4, bool)), seen, loss, 1e-4)
    assert value == 0
    assert (slope == 0).all()


@LOSSES
def test_absent_views_equal_masked_views(loss, hand, cams, masks):
    two = Cameras(cams.K[:2], cams.T_cam_from_world[:2])
    masked = cams._replace(view_mask=np.array([True, True, False, False]))
    loss, seen = np.float32(loss), np.float32(masks)
    got = value_and_slope(hand, masked, seen, loss, 1e-4)
    want = value_and_slope(hand, two, seen[:2], loss, 1e-4)
    np.testing.assert_allclose(got[0], want[0], rtol=1e-5)
    np.testing.assert_allclose(got[1], want[1], atol=1e-4 * np.abs(want[1]).max())


@LOSSES
def test_order_of_views_does_not_matter(loss, hand, cams, masks):
    order = np.array([2, 0, 3, 1])
    mixed = Cameras(*(field[order] for field in cams))
    loss, seen = np.float32(loss), np.float32(masks)
    straight, shuffled = (
        value_and_slope(hand, c, m, loss, 1e-4)[0] for c, m in ((cams, seen), (mixed, seen[order]))
    )
    np.testing.assert_allclose(straight, shuffled, rtol=1e-5)


def test_batch_axes_and_vmap(hand, cams, masks):
    frames = np.stack([hand, hand + 0.004, hand * 1.1]).astype(np.float32)
    many = Cameras(*(np.stack([field] * 3) for field in cams))
    seen, loss = np.float32(masks), np.array([0.3, 0.7], np.float32)
    batched = jax.jit(loss_of)(frames, many, np.stack([seen] * 3), loss, 1e-4)
    mapped = jax.jit(jax.vmap(loss_of, (0, None, None, None, None)))(frames, cams, seen, loss, 1e-4)
    single = [value_and_slope(frame, cams, seen, loss, 1e-4)[0] for frame in frames]
    assert batched.shape == (3,)
    np.testing.assert_allclose(batched, single, rtol=1e-4)
    np.testing.assert_allclose(mapped, single, rtol=1e-4)


@LOSSES
def test_degenerate_hands_are_finite(loss, hand, cams, masks):
    """Shrunk to a point, on a camera's centre, behind every camera, out of sight: a number and a slope."""
    loss, seen = np.float32(loss), np.float32(masks)
    centre = -cams.T_cam_from_world[0, :3, :3].T @ cams.T_cam_from_world[0, :3, 3]
    for vertices in (0 * hand, hand + centre, hand + 1e3 * centre, hand + 1e6, hand * [1, 1, 0]):
        result, gradient = value_and_slope(np.float32(vertices), cams, seen, loss, 1e-6)
        assert np.isfinite(result)
        assert np.isfinite(gradient).all()


def test_masks_of_another_size_are_refused(cams, masks):
    coverage = np.zeros((4, 32, 32), np.float32)
    with pytest.raises(ValueError, match=r"\(32, 32\); got \(64, 64\)"):
        silhouette_l1(coverage, masks, cams.view_mask)
