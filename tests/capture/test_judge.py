"""Hands against the 2D evidence: what is drawn, measured and refused."""

import cv2
import numpy as np
import pytest

from poem_jax.batch import Prediction
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.judge import SEVERAL, judge_hands
from poem_jax.capture.network import Network
from poem_jax.data.lens import project_raw
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.models.config import Config
from poem_jax.models.infer import Prepared
from poem_jax.viz.overlay import MeshInView, silhouette


def stub_network(vertices, joints, root, valid=True):
    """A network that gives known hands to the samples of a batch of four, in the world of the samples."""
    vertices, joints, root = (np.resize(hands, (4, *hands.shape[1:])) for hands in (vertices, joints, root))

    def answer(_, views, cams):
        number = len(views)
        keypoints = np.full((*views.shape[:2], 1, 2), 32.0)
        layers = np.zeros((number, 1, 799, 3))
        solved = valid & cams.view_mask.any(-1)
        return Prediction(vertices, joints, root, keypoints, layers, solved)

    config = Config(image_hw=(64, 64))
    params = {"constants": {"hand": default_hand()._asdict()}}
    return Network(config, Prepared(params, None, config), "stub", answer)


def known_hands(shift=0.0):
    """Vertices and joints (2, point, 3) of a right hand and a left one, in the capture's world."""
    pose = np.zeros((16, 3))
    pose[0] = 0.4, -0.8, 1.1
    meshes = [
        hand_mesh(default_hand(side), pose, np.zeros(10), np.array([x + shift, 0.01, 0.0]), center_joint=9)
        for side, x in (("right", -0.06), ("left", 0.06))
    ]
    return np.stack([mesh.vertices for mesh in meshes]), np.stack([mesh.joints for mesh in meshes])


def photograph(rig, view, points):
    """Project by the text book: Brown's polynomial, then K."""
    x, y, z = (points @ rig.T_cam_from_world[view, :3, :3].T + rig.T_cam_from_world[view, :3, 3]).T
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = rig.dist[view]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        np.ones_like(x),
    ]
    return (rig.K[view] @ bent)[:2].T, z


def test_overlays_and_errors_are_those_of_the_hands_given(make_capture, tmp_path, rig, run):
    capture = make_capture(1, ("right", "left"), keypoints=True)
    vertices, joints = known_hands()
    # The left hand's sample lives in the mirrored world.
    flip = np.array([[[1.0, 1, 1]], [[-1, 1, 1]]])
    network = stub_network(vertices * flip, joints * flip, joints[:, 9] * flip[:, 0])
    written = run(capture, tmp_path / "out", network=network)
    np.testing.assert_allclose(written.arrays["vertices_world"][0], vertices, atol=1e-6)
    hands = written.report["frames"][0]["hands"]
    for view, camera in enumerate(rig.names):
        raw = cv2.imread(str(capture.folder / f"{camera}.png"))
        overlay = cv2.imread(str(tmp_path / "out" / "0000" / f"overlay_{camera}.png"))
        covered = np.zeros(raw.shape[:2], bool)
        for hand, side in enumerate(("right", "left")):
            uv, depth = photograph(rig, view, vertices[hand])
            corners = np.concatenate([uv, depth[:, None]], axis=-1)
            in_view = MeshInView(uv, corners, default_hand(side).faces, (0, 0, 0))
            covered |= silhouette([in_view], raw.shape[:2])
            expected = photograph(rig, view, joints[hand])[0] - capture.hands.keypoints_px[0, hand, view]
            error = np.linalg.norm(expected, axis=-1).mean()
            assert hands[hand]["reprojection_px"][camera] == pytest.approx(error, abs=1e-3)
            assert hands[hand]["joints_shown"][camera] == 1.0
        changed = (overlay != raw).any(-1)
        assert 300 < covered.sum() < 0.5 * covered.size
        assert not (changed & ~covered).any()
        assert changed[covered].mean() > 0.995


@pytest.mark.parametrize(
    ("shift", "valid", "reason"),
    [
        (0.0, False, "the views do not determine where the hand is"),
        (3.0, True, "the hand would lie behind camera 'left_cam'"),
    ],
)
def test_hands_without_a_believable_root_are_invalid(make_capture, tmp_path, run, shift, valid, reason):
    capture = make_capture()
    vertices, joints = known_hands(shift)
    network = stub_network(vertices[:1], joints[:1], joints[:1, 9], valid)
    with pytest.raises(ValueError, match=f"no hand could be reconstructed: {reason}"):
        run(capture, tmp_path / "out", network=network)


def test_heat_maps_are_the_evidence_where_no_key_points_are_given(make_capture, tmp_path, run):
    report = run(make_capture(), tmp_path / "out").report
    assert report["reprojection"]["against"] == "the model's own heat maps"
    assert report["reprojection"]["mean_px"] >= 0


def seen_by(rig, joints, noise_px, rng):
    """A hand whose key points a network sees in every view."""
    views = [project_raw(rig, view, joints)[0] + rng.normal(0, noise_px, (21, 2)) for view in range(3)]
    return HandResult(
        np.ones(3, bool), joints_world=joints, vertices_world=joints, keypoints_px=np.stack(views)
    )


def warnings_of(rig, hands):
    frames = [Frame(str(i), np.zeros((1, 3, 4)), hands=(hand,)) for i, hand in enumerate(hands)]
    return [frame.warnings for frame in judge_hands(frames, rig)]


def exchanged(hand, order):
    return hand._replace(keypoints_px=hand.keypoints_px[order])


@pytest.fixture
def hands(rig):
    rng, beside = np.random.default_rng(0), np.array([0.05, 0.03, -0.06])
    return [seen_by(rig, beside + rng.uniform(-0.06, 0.06, (21, 3)), 3.0, rng) for _ in range(10)]


def test_views_that_fit_are_not_complained_about(rig, hands):
    assert warnings_of(rig, hands) == [()] * 10


def test_exchanged_images_are_told_at_the_first_hand_and_once(rig, hands):
    said = warnings_of(rig, [exchanged(hand, [1, 0, 2]) for hand in hands])
    (warning,) = said[0]
    assert "exchanged" in warning
    assert "not to be trusted" in warning
    assert said[1:] == [()] * 9


def test_what_is_in_doubt_in_one_hand_is_told_by_several(rig, hands):
    """A view that is off by a seventh of the hand's extent."""
    extent = np.linalg.norm(np.ptp(hands[0].keypoints_px[1], axis=0))
    off = [
        hand._replace(keypoints_px=hand.keypoints_px + np.array([[[0, 0]], [[0.1, 0.2]], [[0, 0]]]) * extent)
        for hand in hands
    ]
    said = warnings_of(rig, off)
    assert said[0] == ()
    assert [bool(warnings) for warnings in said].index(True) == SEVERAL - 1


def test_one_hand_given_twice_is_told_once(rig):
    joints = known_hands()[1][0]
    mask = np.ones(rig.num_views, bool)
    nothing = np.full((2, rig.num_views, 4), np.nan)
    points = np.full((2, rig.num_views, 21, 2), np.nan)

    def frame(name, apart):
        hands = tuple(HandResult(mask, joints_world=joints + np.array([x, 0, 0])) for x in (0, apart))
        return Frame(name, nothing, points, hands=hands)

    stream = [frame("0", 0.03), frame("1", 0.004), frame("2", 0.0)]
    told = [judged.warnings for judged in judge_hands(stream, rig)]
    assert told == [(), ("hands 0 and 1 lie at one place, 4 mm apart: is one hand given twice?",), ()]
