import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.capture.keypoint_agreement import judge_fit
from poem_jax.fitting import FitConfig, KeypointNoise, Observations, fit_take, fit_take_adam
from poem_jax.fitting.adam import AdamRecipe, released_start
from poem_jax.fitting.kinematics import keypoint_model, pose_keypoints
from poem_jax.fitting.lm import LMConfig, ShapeMode, TakeObservations, TakeState
from poem_jax.fitting.silhouette import SilhouetteTarget
from poem_jax.fitting.smooth import SmoothConfig, eliminate, smooth, take_cost
from poem_jax.fitting.start import can_be_placed, closed_form_pose
from poem_jax.fitting.take import _fit_take
from poem_jax.geometry.cameras import Cameras, project, resize_intrinsics
from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.geometry.triangulation import triangulate
from poem_jax.geometry.world_origin import move_origin
from poem_jax.hand.mano_file import load
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.keypoint_takes import draw_keypoint_take
from tests.fitting.observed import observed

FRAMES = 24
AT_REST = SmoothConfig(sigma_angle=0.02, sigma_m=0.005)
MODES = {mode: FitConfig(lm=LMConfig(shape_mode=mode)) for mode in ShapeMode}
fit = jax.jit(fit_take, static_argnames="config")


def weighted(take, mask=None) -> Observations:
    """With weights always, so that tests share compiled programs."""
    weights = np.ones(take.uv_px.shape[:-1], np.float32) if mask is None else mask.astype(np.float32)
    return observed(take, weights=weights)


def shared(model, take, mask=None):
    return fit(model, weighted(take, mask), config=MODES[ShapeMode.SHARED])


def error_mm(result, take, what="joints"):
    distance = np.linalg.norm(getattr(result, what) - getattr(take, what), axis=-1)
    return 1000 * distance[np.asarray(result.valid)]


def test_the_start_turns_the_bones(model, takes):
    """A pose with flexion only is found exactly in closed form."""
    angles = np.zeros((1, 15, 3), np.float32)
    angles[..., 0] = np.linspace(0.05, 0.5, 15)
    pose = np.concatenate([[[[0.3, 1.0, -0.4]]], np.einsum("fjk,jkc->fjc", angles, model.axes)], axis=1)
    joints = pose_keypoints(model, jnp.asarray(pose, jnp.float32), jnp.zeros((1, 10))).points + 0.1
    found, wrist = closed_form_pose(model, joints, jnp.ones((1, 21), bool), jnp.zeros((1, 10)))
    np.testing.assert_allclose(wrist, 0.1 * np.ones((1, 3)), atol=1e-6)
    again = pose_keypoints(model, found, jnp.zeros((1, 10))).points + wrist[:, None]
    assert float(jnp.abs(again - joints).max()) < 1e-3


@pytest.mark.parametrize("side", ["right", pytest.param("left", marks=pytest.mark.slow)])
def test_planted_parameters_are_recovered(takes, side):
    hand = default_hand(side)
    take = draw_keypoint_take(hand, FRAMES, 4, 0.0, 11)
    result = shared(keypoint_model(hand), take)
    assert bool(result.valid.all())
    assert error_mm(result, take).max() < 1
    assert error_mm(result, take, "vertices").mean() < 1
    R, truth = (rotation_from_axis_angle(jnp.asarray(p[:, 0], jnp.float32)) for p in (result.pose, take.pose))
    assert float(jnp.abs(R - truth).max()) < 0.05
    mesh = hand_mesh(hand, result.pose, result.shape, result.translation)
    np.testing.assert_allclose(mesh.vertices, result.vertices, atol=1e-6)


@pytest.mark.slow
def test_200_random_hands_are_recovered(model, takes):
    take = takes(200, 4, 0.0, 12, own_shapes=True)
    result = fit(model, observed(take), config=MODES[ShapeMode.PER_FRAME])
    found = error_mm(result, take).max(axis=-1) < 2
    assert len(found) == 200
    assert found.mean() >= 0.98


def fits(model, takes, views, noise_px, mode=ShapeMode.SHARED, outlier_share=0.0):
    """The targets are means over rigs and shapes: eight takes of 24 frames, each with its fit."""
    for seed in range(8):
        take = takes(FRAMES, views, noise_px, seed, outlier_share=outlier_share)
        shape = take.shape[0] if mode is ShapeMode.GIVEN else None
        yield take, fit(model, weighted(take), shape=shape, config=MODES[mode])


@pytest.mark.parametrize(
    ("views", "noise_px", "max_mm"),
    [
        (4, 2.0, 1.7),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((8, 1.0, 0.7), (2, 2.0, 3.5))),
    ],
)
def test_accuracy_with_unknown_shape(model, takes, views, noise_px, max_mm):
    errors, inside = [], []
    for take, result in fits(model, takes, views, noise_px):
        assert bool(result.valid.all())
        errors.append(error_mm(result, take).mean())
        inside.append((np.abs(result.joints - take.joints) < result.sigma_m[..., None]).mean())
    assert np.mean(errors) <= max_mm
    assert 0.60 <= np.mean(inside) <= 0.76


@pytest.mark.slow
def test_accuracy_with_given_shape(model, takes):
    fitted = fits(model, takes, 4, 2.0, ShapeMode.GIVEN)
    assert np.mean([error_mm(result, take, "vertices").mean() for take, result in fitted]) <= 1.5


@pytest.mark.slow
@pytest.mark.parametrize(("views", "noise_px"), [(8, 1.0), (4, 2.0)])
def test_outliers_hardly_matter(model, takes, views, noise_px):
    clean, dirty = (
        np.mean(
            [error_mm(result, take).mean() for take, result in fits(model, takes, views, noise_px, **more)]
        )
        for more in ({}, {"outlier_share": 0.1})
    )
    assert dirty < 1.2 * clean


def test_one_bad_frame_does_not_stop_the_take(model, takes):
    take = takes(FRAMES, 4, 1.0, 13)
    uv = take.uv_px.copy()
    uv[3], uv[5, 1:] = np.nan, np.nan
    result = shared(model, take._replace(uv_px=uv))
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(result.valid)), [3, 5])
    for name in ("pose", "shape", "translation", "joints", "vertices", "sigma_m"):
        assert np.isfinite(getattr(result, name)).all(), name
    assert error_mm(result, take).mean() < 1.5


@pytest.mark.slow
def test_frames_without_key_points_change_nothing(model, takes):
    take, config = takes(FRAMES, 4, 2.0, 13), FitConfig(smooth=AT_REST)
    uv = take.uv_px.copy()
    uv[9:] = np.nan
    padded = smoothed(model, take._replace(uv_px=uv))
    alone = fit(model, weighted(take._replace(uv_px=uv[:9])), config=config)
    assert bool(alone.valid.all())
    for name in ("joints", "vertices", "sigma_m"):
        np.testing.assert_allclose(getattr(padded, name)[:9], getattr(alone, name), atol=2e-5)


@pytest.mark.parametrize("bend", [0.1, pytest.param(1.0, marks=pytest.mark.slow)])
def test_the_wrong_side_is_less_likely(takes, bend):
    """Also of a nearly flat hand; and the right side is never doubted."""
    right, left = (keypoint_model(default_hand(side)) for side in ("right", "left"))
    take = takes(FRAMES, 4, 0.0, 21)
    pose = np.concatenate([take.pose[:, :1], bend * take.pose[:, 1:]], axis=1)
    mesh = hand_mesh(default_hand(), pose, take.shape, np.zeros((FRAMES, 3), np.float32))
    uv, _ = project(take.K[None], take.T_cam_from_world[None], mesh.joints[:, None])
    uv = (uv + np.random.default_rng(0).normal(size=uv.shape)).astype(np.float32)
    own, other = (jax.device_get(shared(model, take._replace(uv_px=uv))) for model in (right, left))
    assert judge_fit("hand", own, other, KeypointNoise()) == []
    (said,) = judge_fit("hand", other, own, KeypointNoise())
    assert "other side" in said


def test_the_first_frame_may_be_the_bad_one(model, takes):
    take = takes(FRAMES, 4, 1.0, 13)
    uv = take.uv_px.copy()
    uv[0] = np.nan
    result = shared(model, take._replace(uv_px=uv))
    assert not result.valid[0]
    np.testing.assert_array_equal(result.shape, np.tile(result.shape[:1], (FRAMES, 1)))
    assert np.abs(result.shape[0]).max() > 0.1
    assert error_mm(result, take).mean() < 1.5


def test_one_wild_frame_does_not_hold_back_the_others(model, takes):
    """The other hand's key points agree between the views, and no pose fits them."""
    take, mirrored = takes(FRAMES, 4, 1.0, 13), draw_keypoint_take(default_hand("left"), FRAMES, 4, 1.0, 13)
    uv = take.uv_px.copy()
    uv[4] = mirrored.uv_px[4][:, ::-1]
    errors = [error_mm(shared(model, take._replace(uv_px=k)), take) for k in (take.uv_px, uv)]
    others = np.arange(FRAMES) != 4
    assert np.median(errors[1][others]) < 1.2 * np.median(errors[0][others])


def test_without_the_wrist_the_palm_still_finds_its_place(model, takes):
    take = takes(FRAMES, 4, 0.5, 18)
    uv = take.uv_px.copy()
    uv[..., 0, :] = np.nan
    errors = error_mm(shared(model, take._replace(uv_px=uv)), take)[:, 1:]
    assert np.median(errors) < 1.5
    assert np.mean(errors.max(-1) < 8) >= 0.9


def test_all_views_masked(model, takes):
    take = takes(FRAMES, 4, 1.0, 13)
    result = shared(model, take, mask=np.zeros(take.uv_px.shape[:-1], bool))
    assert not result.valid.any()
    assert np.isfinite(result.vertices).all()


def test_joints_on_one_line_are_no_hand(model, takes):
    """A straight index finger says nothing about the turn around it; a bent one does, if it is seen well."""
    take = takes(FRAMES, 4, 0.2, 19)
    known = np.zeros((FRAMES, 21, 3, 3), np.float32)
    assert np.asarray(can_be_placed(take.joints, np.ones((FRAMES, 21), bool), known)).all()
    line = np.zeros((3, 21, 3), np.float32)
    line[:, 5:9, 0] = [0, 0.035, 0.06, 0.08]
    line[1:, 7:9, :2] = [0.045, 0.03], [0.03, 0.04]
    line[:, 5:9] += np.random.default_rng(0).normal(scale=1e-3, size=(3, 4, 3))
    shown = np.tile(np.isin(np.arange(21), [5, 6, 7, 8]), (3, 1))
    noise = np.zeros((3, 21, 3, 3), np.float32)
    noise[:] = 1e-6 * np.eye(3)
    noise[2] = np.diag([1e-6, 4e-4, 1e-6])
    np.testing.assert_array_equal(can_be_placed(line, shown, noise), [False, True, False])
    two = np.tile(np.isin(np.arange(21), [5, 17]), (FRAMES, 1))
    assert not np.asarray(can_be_placed(take.joints, two, known)).any()


def test_a_frame_with_one_straight_finger_is_not_valid(model, takes):
    take = takes(FRAMES, 4, 1.0, 13)
    uv = take.uv_px.copy()
    finger = np.arange(5, 9)
    line = take.joints[3, 5] + np.array([0, 0.035, 0.06, 0.08])[:, None] * np.array([0.6, 0.0, 0.8])
    uv[3] = np.nan
    uv[3][:, finger] = project(take.K, take.T_cam_from_world, line.astype(np.float32)[None])[0]
    uv[3][:, finger] += np.random.default_rng(0).normal(size=(4, 4, 2))
    result = shared(model, take._replace(uv_px=uv))
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(result.valid)), [3])


def test_the_elimination_is_exact():
    """Against the dense matrix: solutions, and the blocks of the inverse."""
    rng = np.random.default_rng(0)
    blocks = rng.normal(size=(4, 3, 3))
    blocks = (blocks @ np.swapaxes(blocks, -1, -2) + 3 * np.eye(3)).astype(np.float32)
    coupling = rng.uniform(0.2, 1, (3, 3)).astype(np.float32)
    right = rng.normal(size=(4, 3, 2)).astype(np.float32)
    whole = -np.diag(coupling.ravel(), k=3) - np.diag(coupling.ravel(), k=-3)
    for f in range(4):
        whole[3 * f : 3 * f + 3, 3 * f : 3 * f + 3] = blocks[f]
    chain = eliminate(jnp.asarray(blocks), jnp.asarray(coupling))
    expected = np.linalg.solve(whole, right.reshape(12, 2))
    np.testing.assert_allclose(chain.solve(jnp.asarray(right)).reshape(12, 2), expected, rtol=1e-4, atol=1e-5)
    inverse = np.linalg.inv(whole).reshape(4, 3, 4, 3)
    inverse = np.stack([inverse[f, :, f] for f in range(4)])
    np.testing.assert_allclose(chain.covariance(), inverse, rtol=1e-4, atol=1e-5)


def walking(take, hand, pace, seed=20):
    """The first frame of a take, wandering by `pace` times the walk of `AT_REST`, with 2 px of noise."""
    rng = np.random.default_rng(seed)
    walk = pace * np.cumsum(rng.normal(size=(FRAMES, 51)), axis=0) * np.repeat([0.02, 0.005], [48, 3])
    pose = take.pose[:1] + walk[:, :48].reshape(-1, 16, 3)
    mesh = hand_mesh(hand, pose.astype(np.float32), take.shape, walk[:, 48:].astype(np.float32))
    uv, _ = project(take.K[None], take.T_cam_from_world[None], mesh.joints[:, None])
    uv = (uv + 2 * rng.normal(size=uv.shape)).astype(np.float32)
    return take._replace(uv_px=uv, pose=pose, joints=mesh.joints, vertices=mesh.vertices)


def smoothed(model, take, mask=None):
    return fit(model, weighted(take, mask), config=FitConfig(smooth=AT_REST))


@pytest.mark.slow
def test_the_second_pass(model, takes):
    """Nearer to the truth, surer of it with reason; and a gap is bridged, but not called valid."""
    take = walking(takes(FRAMES, 4, 0.0, 13), model.hand, 1.0)
    mask = np.ones(take.uv_px.shape[:-1], bool)
    mask[7] = False
    plain, smooth = shared(model, take, mask), smoothed(model, take, mask)
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(smooth.valid)), [7])
    assert error_mm(smooth, take).mean() < 0.85 * error_mm(plain, take).mean()
    assert 1000 * np.linalg.norm(smooth.joints[7] - take.joints[7], axis=-1).max() < 12
    assert (smooth.sigma_m[7] == 0).all()
    others = np.arange(FRAMES) != 7
    assert (smooth.sigma_m[others] < plain.sigma_m[others]).all()
    inside = np.abs(smooth.joints - take.joints)[others] < smooth.sigma_m[others][..., None]
    assert 0.60 < inside.mean() < 0.80


@pytest.mark.parametrize(
    "pace", [10.0, *(pytest.param(pace, marks=pytest.mark.slow) for pace in (0.3, 1.0, 5.0))]
)
def test_the_second_pass_does_no_harm_at_any_pace(model, takes, pace):
    """Ten times as fast as `SmoothConfig` says, or at rest: means of three takes.

    The fast ones leave the limits of the joints, which both passes pay for.
    """
    ratios, calibration, absolute = [], [], []
    for seed in range(3):
        take = walking(takes(FRAMES, 4, 0.0, seed), model.hand, pace, seed)
        plain, smooth = shared(model, take), smoothed(model, take)
        ratios.append(error_mm(smooth, take).mean() / error_mm(plain, take).mean())
        inside = [(np.abs(r.joints - take.joints) < r.sigma_m[..., None]).mean() for r in (smooth, plain)]
        calibration.append(inside[0] - inside[1])
        absolute.append(inside[0])
    assert np.mean(ratios) < 1.1
    assert abs(np.mean(calibration)) < 0.1
    assert pace > 1 or 0.60 < np.mean(absolute) < 0.80


def test_the_second_pass_survives_unrelated_frames_and_a_wild_one(model, takes):
    """Of different moments, one of them another hand's: the others stay where the first pass put them."""
    take = takes(FRAMES, 4, 1.0, 13)
    uv = take.uv_px.copy()
    uv[4] = draw_keypoint_take(default_hand("left"), FRAMES, 4, 1.0, 13).uv_px[4][:, ::-1]
    plain, smooth = (f(model, take._replace(uv_px=uv)) for f in (shared, smoothed))
    assert bool(smooth.valid.all())
    others = np.arange(FRAMES) != 4
    assert np.median(error_mm(smooth, take)[others]) < 1.1 * np.median(error_mm(plain, take)[others])


@pytest.mark.slow
def test_the_second_pass_never_raises_the_cost(model, takes):
    """Also where its model is wrong: unrelated poses, held together as if they were one at rest."""
    take = takes(4, 4, 1.0, 13)
    frames = (jnp.broadcast_to(x, (4, *x.shape)) for x in (take.K, take.T_cam_from_world))
    weights = jnp.ones(take.uv_px.shape[:-1])
    seen = TakeObservations(Observations(jnp.asarray(take.uv_px), weights, *frames), jnp.ones(4, bool))
    pose, wrist = closed_form_pose(model, take.joints, jnp.ones((4, 21), bool), jnp.zeros((4, 10)))
    begin = TakeState(pose, wrist, jnp.zeros((4, 10)))

    @jax.jit
    def costs(model, state):
        walk = SmoothConfig(sigma_angle=1e-3, sigma_m=1e-4)
        end, motion = smooth(model, seen, state, LMConfig(), walk, jnp.full(3, 1 / 30))
        return tuple(take_cost(model, seen, s, LMConfig(), motion) for s in (state, end))

    before, after = costs(model, begin)
    assert after < before


def test_a_shape_mode_may_be_named():
    assert LMConfig(shape_mode="per_frame").shape_mode is ShapeMode.PER_FRAME
    with pytest.raises(ValueError, match="frames"):
        LMConfig(shape_mode="frames")
    with pytest.raises(ValueError, match="PER_FRAME"):
        FitConfig(lm=LMConfig(shape_mode=ShapeMode.PER_FRAME), smooth=SmoothConfig())


@pytest.mark.slow
def test_hands_of_both_sides_may_be_mapped_over(takes):
    models = [keypoint_model(default_hand(side)) for side in ("right", "left")]
    both = [draw_keypoint_take(default_hand(side), 8, 4, 1.0, 13) for side in ("right", "left")]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *models)
    uv = np.stack([take.uv_px for take in both])
    mapped = jax.jit(jax.vmap(fit_take, (0, Observations(0, None, None, None))))
    result = mapped(stacked, observed(both[0], uv_px=uv))
    for index, (model, take) in enumerate(zip(models, both, strict=True)):
        alone = fit(model, observed(take), config=FitConfig())
        np.testing.assert_allclose(result.joints[index], alone.joints, atol=2e-5)


@pytest.mark.slow
def test_the_size_of_the_images_does_not_matter(model, takes):
    """Twice the pixels, twice the noise: the same hand."""
    take = takes(FRAMES, 4, 3.0, 13, outlier_share=0.05)
    zoom = np.diag([2, 2, 1]).astype(np.float32)
    config = FitConfig(noise=KeypointNoise.of_images(np.array([[2560, 1440]])))
    one = shared(model, take)
    two = fit(model, weighted(take)._replace(uv_px=2 * take.uv_px, K=zoom @ take.K), config=config)
    np.testing.assert_array_equal(one.inlier_mask, two.inlier_mask)
    np.testing.assert_allclose(one.joints, two.joints, atol=2e-5)
    np.testing.assert_allclose(2 * one.sigma_px, two.sigma_px, rtol=1e-4)
    np.testing.assert_allclose(one.sigma_m, two.sigma_m, rtol=1e-2)


def test_bad_input_raises(model, takes):
    take = takes(2, 3, 0.0, 17)
    K, T = take.K, take.T_cam_from_world

    def refused(match, shape=None, mode=ShapeMode.SHARED, **changes):
        with pytest.raises(ValueError, match=match):
            fit_take(model, observed(take, **changes), shape, MODES[mode])

    refused("at least two views", uv_px=take.uv_px[:, :1], K=K[:1], T_cam_from_world=T[:1])
    refused("same views", K=K[:2], T_cam_from_world=T[:2])
    refused(r"T_cam_from_world.*\(3, 4, 4\).*got \(3, 3, 4\)", T_cam_from_world=T[:, :3])
    refused("21, 2", uv_px=take.uv_px[0])
    refused("GIVEN", shape=np.zeros(10, np.float32))
    refused("`weights` must have shape", weights=np.ones((2, 3), np.float32))
    refused(r"\(10,\) or \(2, 10\); got \(5,\)", shape=np.zeros(5), mode=ShapeMode.GIVEN)


@pytest.mark.parametrize("origin", [[50e3, 20e3, 100.0], [500e3, 4500e3, 300.0]])
def test_a_world_far_from_its_origin_gives_the_same_hand(model, takes, origin):
    """A hall survey, and projected map coordinates; what is added back is added in float64."""
    take, origin = takes(FRAMES, 4, 1.0, 13), np.asarray(origin)
    T = take.T_cam_from_world.astype(np.float64)
    far = move_origin(T, -origin)
    near, result = (fit_take(model, weighted(take)._replace(T_cam_from_world=t)) for t in (T, far))
    assert bool(result.valid.all())
    for name in ("joints", "vertices", "translation"):
        assert getattr(result, name).dtype == np.float64
        np.testing.assert_allclose(getattr(result, name) - origin, getattr(near, name), atol=3e-5)
    np.testing.assert_allclose(result.reprojection_px, near.reprojection_px, atol=0.05)
    with pytest.raises(ValueError, match=r"origin.*must be float64"):
        fit_take(model, weighted(take)._replace(T_cam_from_world=far.astype(np.float32)))


@pytest.mark.slow
@pytest.mark.parametrize("origin", [[50e3, 20e3, 100.0]])
def test_a_far_world_moves_start_and_silhouettes_of_the_iterative_fit(model, takes, origin):
    take, origin = takes(1, 2, 0.0, 13), np.asarray(origin)
    T = take.T_cam_from_world.astype(np.float64)
    far = move_origin(T, -origin)
    K = resize_intrinsics(take.K, (720, 1280), (24, 24))
    begin = released_start(None, np.array([0.1, 0, 0], np.float32))
    begin = jax.tree.map(lambda x: np.asarray(x, np.float64)[None], begin)

    def run(T, start):
        target = SilhouetteTarget(np.ones((1, 2, 24, 24), np.float32), Cameras(K[None], T[None]))
        recipe = AdamRecipe(steps=3)
        return fit_take_adam(
            model, observed(take, T_cam_from_world=T), start, recipe, silhouettes=target
        ).joints

    moved = run(far, begin._replace(translation=begin.translation + origin)) - origin
    np.testing.assert_allclose(moved, run(T, begin), atol=3e-5)


@pytest.mark.parity
def test_released_key_points(shared_dir):
    """Closer to the truth than 1.3 mm, and than triangulation alone."""
    folder = shared_dir / "reference" / "poem_v1"
    golden = np.load(folder / "golden_fit.npz")
    keypoints = golden["keypoints"][None]
    cameras = (golden["cam_intr"], golden["cam_extr_master_to_cam"])
    seen = Observations(keypoints[..., :2], keypoints[..., 2], *cameras)
    hand = keypoint_model(load(folder / "fake_mano.npz"))
    result = fit(hand, seen, config=FitConfig())
    points, _ = triangulate(keypoints[0, ..., :2], *cameras, weights=np.sqrt(keypoints[0, ..., 2]))
    fitted, dlt = (
        1000 * np.linalg.norm(joints - golden["gt_joints"], axis=-1).mean()
        for joints in (result.joints[0], points)
    )
    assert fitted <= 1.3
    assert fitted < dlt


def at_times(model, take, mask, time_s):
    return fit_take(model, weighted(take, mask), config=FitConfig(smooth=AT_REST), time_s=time_s)


@pytest.mark.slow
def test_the_walk_grows_with_the_time_between_frames(model, takes):
    """Every second frame left out is every second frame unseen, if the others say when they were taken."""
    take = walking(takes(FRAMES, 4, 0.0, 13), model.hand, 0.5)
    every = np.arange(FRAMES) / 30
    mask = np.ones(take.uv_px.shape[:-1], bool)
    mask[1::2] = False
    unseen = at_times(model, take, mask, every)
    half = FRAMES // 2
    order = np.concatenate([np.arange(0, FRAMES, 2), np.arange(1, FRAMES, 2)])
    mask = np.ones(take.uv_px.shape[:-1], bool)
    mask[half:] = False
    kept = take._replace(uv_px=take.uv_px[order])
    times = np.concatenate([every[::2], every[-1] + np.arange(1, 1 + half) / 30])
    left_out = at_times(model, kept, mask, times)
    away = 1000 * np.linalg.norm(left_out.joints[:half] - unseen.joints[::2], axis=-1)
    assert away.mean() < 0.1
    wrong = at_times(model, kept, mask, times / 1000)
    assert 1000 * np.linalg.norm(wrong.joints[:half] - unseen.joints[::2], axis=-1).mean() > 5 * away.mean()
    whole = at_times(model, take, np.ones_like(mask), every)
    near = np.linalg.norm(whole.joints[::2] - left_out.joints[:half], axis=-1)
    assert (near < 3 * whole.sigma_m[::2]).mean() > 0.95, "what was left out would have changed little"


@pytest.mark.slow
def test_times_compile_nothing_and_frames_alone_are_told(model, takes):
    """Times far from zero, too; and what the first pass found stays on record."""
    take = takes(FRAMES, 4, 2.0, 13)
    mask = np.ones(take.uv_px.shape[:-1], bool)
    plain = shared(model, take, mask)
    one = at_times(model, take, mask, None)
    np.testing.assert_allclose(one.alone, plain.joints, atol=1e-5)
    np.testing.assert_array_equal(plain.alone, plain.joints)
    before = _fit_take._cache_size()
    late = at_times(model, take, mask, 1e6 + np.arange(FRAMES) / 30)
    assert _fit_take._cache_size() == before
    np.testing.assert_allclose(late.joints, one.joints, atol=1e-5)


@pytest.mark.parametrize(
    ("time_s", "said"),
    [
        (np.zeros(FRAMES), "grow from frame to frame; got 0.0 and 0.0 of frames 0 and 1"),
        (np.full(FRAMES, np.nan), "got nan"),
        (np.arange(3.0), r"shape \(24,\), one moment a frame; got \(3,\)"),
    ],
)
def test_times_that_cannot_be_right_raise(model, takes, time_s, said):
    take = takes(FRAMES, 4, 2.0, 13)
    with pytest.raises(ValueError, match=said):
        at_times(model, take, None, time_s)
