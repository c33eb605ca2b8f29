"""Hands by a network: left hands as mirrored right ones, batches, and hands that cannot be predicted."""

import numpy as np

from poem_jax.batch import Prediction
from poem_jax.capture.crop import crop_hands, hand_squares
from poem_jax.capture.engines import by_network
from poem_jax.capture.frame import HandCrops, HandResult
from poem_jax.capture.network import MAX_BATCH, UNDETERMINED, Network, predict_hands
from poem_jax.capture.read import read_images
from poem_jax.capture.report import Clock
from poem_jax.capture.take import read_take
from poem_jax.geometry.cameras import project
from poem_jax.hand.model import hand_mesh, mirror
from poem_jax.hand.template import default_hand
from poem_jax.models.config import Config, CropConfig

HW = (64, 64)


def cropped(capture, sides=None):
    """The take, with sides of its hands as wished, and the list of its frames up to `crop`."""
    take = read_take(capture.folder)
    take = take if sides is None else take._replace(hand_sides=sides)
    unused = np.zeros(take.rig.num_views, bool)
    frames = (
        frame._replace(
            squares_px=hand_squares(frame, take.rig),
            hands=tuple(HandResult(unused) for _ in take.hand_sides),
        )
        for frame in take.frames
    )
    return take, list(crop_hands(read_images(frames, take.rig), take.rig, CropConfig(1.5), HW))


class Recorder:
    """A model that writes down what it is fed, and answers with known hands."""

    def __init__(self, answer=lambda views, cams: {}):
        self.fed = []
        self.answer = answer

    def __call__(self, _, views, cams):
        self.fed.append((views, cams))
        number, places = len(views), np.arange(3 * len(views)).reshape(-1, 3) / 100
        known = {
            "vertices_world": np.zeros((number, 778, 3)) + places[:, None],
            "joints_world": np.zeros((number, 21, 3)) + places[:, None],
            "root_world": places,
            "keypoints_px": np.full((*views.shape[:2], 1, 2), 20.0),
            "layers_world": np.zeros((number, 1, 799, 3)),
            "valid": cams.view_mask.any(-1),
        }
        return Prediction(**{**known, **self.answer(views, cams)})


def network(model):
    return Network(Config(image_hw=HW), None, "stub", model)


def test_left_hands_are_fed_mirrored(make_capture):
    capture = make_capture()
    model = Recorder()
    for sides in (("right",), ("left",)):
        take, frames = cropped(capture, sides)
        list(predict_hands(frames, take, network(model)))
    (right, right_cams), (left, left_cams) = model.fed
    np.testing.assert_array_equal(left, right[:, :, :, ::-1])
    # Mirrored points land on the flipped pixels of their originals.
    joints = capture.joints_world[0, 0]
    mirrored = joints * [-1, 1, 1]
    for view in range(3):
        uv, depth = project(right_cams.K[0, view], right_cams.T_cam_from_world[0, view], joints)
        uv_left, depth_left = project(left_cams.K[0, view], left_cams.T_cam_from_world[0, view], mirrored)
        np.testing.assert_allclose(uv_left, np.stack([64 - uv[:, 0], uv[:, 1]], -1), atol=1e-3)
        np.testing.assert_allclose(depth_left, depth, rtol=1e-5)
        np.testing.assert_allclose(np.linalg.det(left_cams.T_cam_from_world[0, view]), 1, rtol=1e-5)


def test_what_comes_back_for_a_left_hand_is_a_left_hand(make_capture, rig):
    """Mesh, joints, parameters and key points, all of one mirrored hand."""
    rng = np.random.default_rng(0)
    right = default_hand("right")
    pose, shape, translation = rng.normal(size=(16, 3)) * 0.3, rng.normal(size=10), np.array([0.01, 0, 0.02])
    mesh = hand_mesh(right, pose, shape, translation)

    def answer(views, cams):
        def tiled(array):
            return np.tile(array, (len(views), *[1] * np.ndim(array)))

        parameters = {"pose": tiled(pose), "shape": tiled(shape), "translation": tiled(translation)}
        return {"vertices_world": tiled(mesh.vertices), "joints_world": tiled(mesh.joints), **parameters}

    take, frames = cropped(make_capture(), ("left",))
    (frame,) = predict_hands(frames, take, network(Recorder(answer)))
    (hand,) = frame.hands
    again = hand_mesh(mirror(right), hand.pose, hand.shape, hand.translation)
    np.testing.assert_allclose(hand.vertices_world, mesh.vertices * [-1, 1, 1])
    np.testing.assert_allclose(again.vertices, hand.vertices_world, atol=1e-6)
    np.testing.assert_allclose(hand.joints_world, mesh.joints * [-1, 1, 1])


def test_heat_map_points_are_moved_to_the_photographs(make_capture, rig):
    """Pixel (20, 20) of a flipped crop is pixel (44, 20) of the crop as it was cut."""
    take, frames = cropped(make_capture(), ("left",))
    (frame,) = predict_hands(frames, take, network(Recorder()))
    crops = frames[0].crops[0]
    points = frame.hands[0].keypoints_px
    view = 2  # The camera without distortion.
    expected = rig.K[view] @ np.linalg.inv(crops.K[view].astype(float)) @ [44, 20, 1]
    np.testing.assert_allclose(points[view, 0], expected[:2], atol=1e-3)


def test_batches_have_one_size_and_every_hand_its_own_answer(make_capture):
    capture = make_capture(5, ("right", "right"))
    model = Recorder()
    take, frames = cropped(capture)
    done = list(predict_hands(frames, take, network(model)))
    assert [len(views) for views, _ in model.fed] == [MAX_BATCH] * 3
    assert model.fed[-1][1].view_mask.any(-1).tolist() == [True, True, False, False]
    roots = np.array([[hand.root_world for hand in frame.hands] for frame in done]).reshape(-1, 3)
    batch = np.arange(3 * MAX_BATCH).reshape(-1, 3) / 100
    np.testing.assert_allclose(roots, np.concatenate([batch, batch, batch[:2]]))
    assert not any(frame.crops for frame in done), "crops do not travel on"


def test_hands_that_cannot_be_predicted_say_why(make_capture):
    take, (frame,) = cropped(make_capture(1, ("right", "right", "right")))
    _, crops, other = frame.crops
    alone = crops._replace(view_mask=np.array([False, True, False]))
    hands = (HandResult(np.zeros(3, bool), "a reason"), *frame.hands[1:])
    frame = frame._replace(crops=(None, alone, other), hands=hands)
    unsolved = Recorder(lambda views, cams: {"valid": np.zeros(len(views), bool)})
    (done,) = predict_hands([frame], take, network(unsolved))
    reasons = [hand.reason for hand in done.hands]
    assert reasons == ["a reason", "seen in 1 view(s); two are needed", UNDETERMINED]


def test_a_group_without_hands_costs_nothing(make_capture):
    take, (frame,) = cropped(make_capture())
    model = Recorder()
    nothing = HandCrops(*frame.crops[0][:3], np.zeros(3, bool))
    (done,) = predict_hands([frame._replace(crops=(nothing,))], take, network(model))
    assert done.hands[0].reason == "seen in 0 view(s); two are needed"
    assert not model.fed


def test_crops_are_as_wide_as_the_model_was_trained_with(make_capture):
    """Twice the ratio sees twice as much: half the focal length, about the same centre."""
    take = read_take(make_capture().folder)
    fed = []
    for ratio in (1.0, 2.0):
        model = Recorder(lambda views, cams: {"valid": np.zeros(len(views), bool)})
        wide = Network(Config(image_hw=HW, crop=CropConfig(ratio)), None, "stub", model)
        list(by_network(take.frames, take, Clock(), wide))
        fed.append(model.fed[0][1].K[0])
    np.testing.assert_allclose(fed[0][:, 0, 0], 2 * fed[1][:, 0, 0], rtol=1e-5)
    np.testing.assert_allclose(fed[0][:, :2, 2] - 32, 2 * (fed[1][:, :2, 2] - 32), atol=1e-3)
