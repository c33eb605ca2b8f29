"""The same hand in all cameras and frames: planted scenes of every kind of fault, and real captures."""

import numpy as np
import pytest

from poem_jax.capture import hand_matching, hand_tracks
from poem_jax.capture.association import associate_hands
from poem_jax.capture.hand_choice import name_sides
from poem_jax.detection import DetectedHand
from poem_jax.geometry.rig import HALF_PIXEL, Rig
from poem_jax.geometry.transforms import invert_rigid, rigid, rotation_from_axis_angle
from tests.capture import planted_scenes as planted

FEW = (planted.clean, planted.seen_twice, planted.crossing, planted.missed_views)


def associated(scene: planted.Scene):
    return associate_hands(scene.found, scene.rig, max_hands=scene.max_hands)


def grades_of(seed: int):
    """(kind, rig) -> mistakes and warnings of one scene each."""
    results = {}
    for kind in planted.KINDS:
        for rig in planted.RIGS:
            scene = planted.planted(kind, rig, seed)
            got = associated(scene)
            results[kind.__name__, rig] = planted.mistakes(scene, got), got.warnings
    return results


@pytest.fixture(scope="module")
def graded():
    return grades_of(0)


def says_that_hands_are_unsure(warnings: tuple[str, ...]) -> bool:
    """A planted false hand is told of in any case; that is no word about the hands that are kept."""
    return any(not warning.startswith("what looks like a hand to one camera") for warning in warnings)


def test_nearly_all_planted_scenes_come_out_right(graded):
    wrong = {place: mistakes for place, (mistakes, _) in graded.items() if mistakes}
    assert len(graded) >= 40
    assert len(wrong) <= 0.05 * len(graded), wrong


def test_no_planted_scene_is_silently_wrong(graded):
    assert not silently_wrong(graded)


def silently_wrong(graded):
    return {
        place: mistakes
        for place, (mistakes, warnings) in graded.items()
        if mistakes and not says_that_hands_are_unsure(warnings)
    }


@pytest.mark.slow
def test_scenes_of_other_seeds():
    many = [grades_of(seed) for seed in range(100, 105)]
    wrong = [place for graded in many for place, (mistakes, _) in graded.items() if mistakes]
    assert len(wrong) <= 0.05 * sum(map(len, many)), wrong
    assert not any(map(silently_wrong, many))


@pytest.mark.parametrize(
    "kind",
    ["clean", "missed_views", "crossing", "leaves_and_returns", "one_hand", "strong_lens"],
)
def test_scenes_without_doubt_carry_no_warning(graded, kind):
    assert [graded[kind, rig] for rig in planted.RIGS] == [([], ())] * len(planted.RIGS)


def test_false_hands_are_named_with_their_camera(graded):
    for rig in planted.RIGS:
        (warning,) = graded["false_in_one_view", rig][1]
        assert warning.startswith("what looks like a hand to one camera")
        assert "(cam_" in warning


@pytest.mark.parametrize("broken", ["rays", "sides", "motion"])
def test_the_scenes_notice_broken_code(monkeypatch, broken):
    if broken == "rays":
        monkeypatch.setattr(hand_matching, "RAY_SIGMA_M", 10.0)
    elif broken == "sides":
        monkeypatch.setattr("poem_jax.capture.sightings.MAX_VOTE", 0.0)
    else:
        monkeypatch.setattr(hand_tracks, "mean_distance", lambda a, b: 0.0)
    kinds = [planted.two_people_four_hands] if broken == "motion" else FEW
    rigs = ("two", "four") if broken == "motion" else ("four",)
    scenes = [planted.planted(kind, rig, 0) for kind in kinds for rig in rigs]
    wrong = sum(bool(planted.mistakes(scene, associated(scene))) for scene in scenes)
    assert wrong >= len(scenes) / 4


@pytest.mark.parametrize("kind", [planted.missed_views, planted.false_in_several_views])
def test_the_order_of_detections_and_cameras_is_free(kind):
    scene = planted.planted(kind, "four", 1)
    views = [2, 0, 3, 1]
    rig = scene.rig.select([scene.rig.names[view] for view in views])
    turned = [[list(reversed(frame[view])) for view in views] for frame in scene.found]
    got, expected = associate_hands(turned, rig), associated(scene)
    assert got.hand_side == expected.hand_side
    np.testing.assert_array_equal(got.keypoints_px, expected.keypoints_px[:, :, views])


def test_the_world_frame_is_free():
    scene = planted.planted(planted.missed_views, "four", 2)
    T = rigid(rotation_from_axis_angle(np.array([0.3, -1.0, 2.0])), np.array([4e5, -7e4, 20.0]))
    rig = scene.rig._replace(T_cam_from_world=scene.rig.T_cam_from_world @ invert_rigid(T))
    got, expected = associate_hands(scene.found, rig), associated(scene)
    np.testing.assert_array_equal(got.keypoints_px, expected.keypoints_px)


def test_right_hands_come_first_and_then_what_was_seen_more():
    scene = planted.planted(planted.two_people_four_hands, "four", 0)
    got = associated(scene)
    assert got.hand_side == ("right", "right", "left", "left")
    seen = np.isfinite(got.score).sum((0, 2))
    assert seen[0] >= seen[1]
    assert seen[2] >= seen[3]


def test_one_hand_is_the_one_followed_best():
    scene = planted.planted(planted.clean, "four", 3)
    found = [
        [hands if f % 2 else [h for h in hands if h.side == "left"] for hands in views]
        for f, views in enumerate(scene.found)
    ]
    got = associate_hands(found, scene.rig, max_hands=1)
    assert got.hand_side == ("left",)
    assert any("--max-hands" in warning for warning in got.warnings)


def test_one_frame_is_enough():
    scene = planted.planted(planted.clean, "four", 4)
    got = associate_hands(scene.found[:1], scene.rig)
    assert got.hand_side == ("right", "left")
    assert np.isfinite(got.keypoints_px).all()


def test_key_points_that_no_ray_reaches_are_kept_as_given():
    scene = planted.planted(planted.clean, "four", 5)
    hand = scene.found[0][0][0]
    hand.keypoints_px[4] = [9000.0, 9000.0]
    hand.keypoints_px[8] = np.nan
    got = associated(scene)
    assert any(np.array_equal(hand.keypoints_px, px, equal_nan=True) for px in got.keypoints_px[0, :, 0])


def test_a_hand_of_one_view_has_no_place_and_is_named():
    scene = planted.planted(planted.clean, "four", 6)
    found = [
        [
            [h for h, true in zip(hands, truth, strict=True) if true == 0 or view == 1]
            for view, (hands, truth) in enumerate(zip(views, truths, strict=True))
        ]
        for views, truths in zip(scene.found, scene.truth, strict=True)
    ]
    got = associate_hands(found, scene.rig)
    assert got.hand_side == ("right",)
    (warning,) = got.warnings
    assert "cam_1 in 9 frames" in warning


def test_a_single_camera_tells_hands_by_side_alone():
    scene = planted.planted(planted.clean, "four", 7)
    rig = scene.rig.select(["cam_2"])
    found = [
        [[h._replace(side=scene.sides[t]) for h, t in zip(views[2], truths[2], strict=True)]]
        for views, truths in zip(scene.found, scene.truth, strict=True)
    ]
    got = associate_hands(found, rig)
    assert got.hand_side == ("right", "left")
    assert np.isfinite(got.keypoints_px).all()
    assert got.warnings[0].startswith("only camera cam_2 sees hands")
    found[3][0] = [h._replace(side="left") for h in found[3][0]]
    assert "several hands of one side in frame 3" in associate_hands(found, rig).warnings[1]
    assert associate_hands(found, rig, max_hands=1).hand_side == ("left",)


@pytest.mark.parametrize(
    ("votes", "sides", "warning"),
    [
        ([[2.0, 2.0], [-2.0, -1.0]], ["right", "left"], None),
        ([[2.0, 2.0, -2.0, 2.0], [2.0, -2.0, -1.5, 2.0]], ["right", "left"], "named the other side"),
        ([[2.0, 2.0], [2.0, 2.0]], ["right", "right"], "two people's"),
        ([[-2.0, -2.0, 1.9], [-2.0, -2.0, 2.0]], ["left", "left"], "two people's"),
        ([[2.0, -1.5]], ["right"], "57% of the votes"),
    ],
)
def test_sides_are_named_by_all_votes(votes, sides, warning):
    got, told = name_sides([np.array(of_hand) for of_hand in votes])
    assert got == sides
    assert len(told) == (warning is not None)
    assert warning is None or warning in told[0][0]


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda T: np.diag([1.0, -1, -1, 1]) @ T, "OpenGL or Blender axes"),
        (lambda T: rigid(T[:, :3, :3], 1000 * T[:, :3, 3]), "millimetres"),
    ],
)
def test_where_no_two_views_agree_the_mistake_in_the_rig_is_named(change, cause):
    scene = planted.planted(planted.clean, "four", 0)
    wrong = scene.rig._replace(T_cam_from_world=change(scene.rig.T_cam_from_world))
    with pytest.raises(ValueError, match=f"no two of the cameras .* agree on a hand.*{cause}"):
        associate_hands(scene.found, wrong)


def test_errors_say_what_is_missing():
    scene = planted.planted(planted.clean, "two", 0)
    with pytest.raises(ValueError, match="`max_hands` must be 1 or more; got 0"):
        associate_hands(scene.found, scene.rig, max_hands=0)
    with pytest.raises(ValueError, match=r"2 views of the rig \(cam_0, cam_1\).*frame 0 has 1"):
        associate_hands([views[:1] for views in scene.found], scene.rig)
    with pytest.raises(ValueError, match="no hand was found in any image of 2 frames and 2 views"):
        associate_hands([[[], []]] * 2, scene.rig)
    apart = [[views[0], []] if frame % 2 else [[], views[1]] for frame, views in enumerate(scene.found)]
    with pytest.raises(ValueError, match="no two of the cameras cam_0, cam_1 agree on a hand"):
        associate_hands(apart, scene.rig)


CAPTURES = ("caliscope_4cam_hands", "caliscope_4cam_board")


def real_capture(shared_dir, name):
    """Detections (frame, view, found) of MediaPipe, the rig, and the stored hands with their frame."""
    detected = np.load(shared_dir / "reference/mediapipe_hands/golden_static.npz")
    stored = np.load(shared_dir / "data" / name / "pseudo_gt.npz")
    K = stored["K"].astype(float)
    K[:, :2, 2] += HALF_PIXEL
    T = rigid(stored["R_world2cam"], stored["t_world2cam"].reshape(-1, 3))
    rig = Rig(
        tuple(f"cam_{view}" for view in range(4)),
        stored["image_size_wh"].astype(int),
        K,
        stored["dist"].astype(float),
        T,
    )

    def hands(frame, view):
        rows = np.flatnonzero(detected["image"] == f"{name}/frames/{frame:04d}/cam_{view}.jpg")
        # MediaPipe names sides as of a mirrored image.
        sides = {"Left": "right", "Right": "left"}
        return [
            DetectedHand(
                detected["keypoints_px"][row],
                sides[str(detected["mediapipe_label"][row])],
                float(detected["score"][row]),
                1.0,
            )
            for row in rows
        ]

    frames = sorted(set(stored["frame"].tolist()))
    return [[hands(frame, view) for view in range(4)] for frame in frames], rig, stored, frames


@pytest.mark.parametrize("name", CAPTURES)
@pytest.mark.parametrize("views", [(0, 1, 2, 3), (0, 1, 2), (1, 2, 3), (0, 1), (0, 2), (2, 3)])
def test_all_hands_of_real_captures_are_found(shared_dir, name, views):
    found, rig, stored, frames = real_capture(shared_dir, name)
    some = rig.select([rig.names[view] for view in views])
    got = associate_hands([[of_frame[view] for view in views] for of_frame in found], some)
    assert got.hand_side == ("right", "left")
    # Of two views alone those of one frame fit badly; three are never in doubt.
    assert all("its rays fit badly" in warning for warning in got.warnings)
    assert len(views) == 2 or not got.warnings
    for frame, side, expected in zip(
        stored["frame"], stored["hand_side"], stored["keypoints_2d"], strict=True
    ):
        px = got.keypoints_px[frames.index(int(frame)), got.hand_side.index(str(side))]
        expected = expected[list(views)] + HALF_PIXEL
        np.testing.assert_array_equal(np.isnan(px), np.isnan(expected))
        apart = np.linalg.norm(px - expected, axis=-1)
        assert np.nanmax(np.median(apart, axis=-1), initial=0) < 6
