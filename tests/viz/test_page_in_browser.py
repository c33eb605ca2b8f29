"""The page in headless Chromium: what is to be seen, and what its controls do."""

import numpy as np
import pytest

from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import transform_points
from poem_jax.viz.first_view import initial_view, view_camera
from poem_jax.viz.overlay import MeshInView, silhouette
from poem_jax.viz.page import HAND_RGB, Caption, PageFrame, write_page
from tests.viz.browser import Browser, Tab
from tests.viz.pages import (
    FACES,
    GREYS,
    PICTURE_HW,
    K_of,
    cameras,
    frames,
    hand,
    joint_weights,
    page_hand,
)

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    chromium = Browser(tmp_path_factory.mktemp("profile"))
    yield chromium
    chromium.close()


@pytest.fixture
def open_page(browser, tmp_path):
    """Write a page and open it; in the end it must have complained of nothing, nor asked the network."""
    tabs = []

    def opened(take, dark=False, **options):
        page = write_page(
            tmp_path / "index.html", take, cameras(), FACES, joint_weights=joint_weights(), **options
        )
        tabs.append(Tab(browser, page, dark))
        return tabs[-1]

    yield opened
    for tab in tabs:
        assert tab.problems() == []
        tab.close()


def coloured(image, side="right"):
    """Pixels in a hand's colour: pictures, panels and words are grey."""
    red_over_blue = image[..., 0].astype(int) - image[..., 2]
    return red_over_blue > 40 if side == "right" else red_over_blue < -40


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def drawn(vertices, side, K, T_cam_from_world, hw):
    """Pixels that the rasteriser gives to a hand."""
    px, cam = project(K, T_cam_from_world, vertices)[0], transform_points(T_cam_from_world, vertices)
    return silhouette([MeshInView(px, cam, FACES[side], HAND_RGB[side])], hw)


def through_camera(camera, hw):
    """K of the window in which a camera's picture just fits, and the scale of the picture."""
    scale = min(hw[0] / camera.hw[0], hw[1] / camera.hw[1])
    K = K_of(camera) * [[scale], [scale], [1]]
    K[:2, 2] = hw[1] / 2, hw[0] / 2
    return K, scale


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_hand_is_where_the_rasteriser_puts_it(open_page, side):
    vertices = hand(side)
    tab = open_page([frames(1)[0]._replace(hands={side: page_hand(side)})])
    stage = tab.shot("#stage")
    view = initial_view(vertices, np.stack([camera.T_cam_from_world for camera in cameras()]))
    expected = drawn(vertices, side, *view_camera(view, stage.shape[:2]), stage.shape[:2])
    assert overlap(coloured(stage, side), expected) > 0.95
    assert tab.js("document.getElementById('player').hidden")


def test_a_camera_shows_its_picture_with_the_hand_at_its_place(open_page):
    (frame,) = frames(1)
    tab = open_page([frame])
    tab.click("#show-keypoints")
    for index in (0, 2):
        camera = cameras()[index]
        tab.click(f"#cameras button:nth-of-type({index + 2})")
        assert camera.name in tab.text("#where")
        stage = tab.shot("#stage")
        hw = stage.shape[:2]
        K, scale = through_camera(camera, hw)
        expected = drawn(hand(), "right", K, camera.T_cam_from_world, hw)
        assert overlap(coloured(stage), expected) > 0.95
        half_w, half_h = scale * PICTURE_HW[1] / 2, scale * PICTURE_HW[0] / 2
        for sign_x, sign_y in ((-1, 1), (1, -1), (1, 1)):
            corner = [int(hw[0] / 2 + sign_y * (half_h - 40)), int(hw[1] / 2 + sign_x * (half_w - 4))]
            np.testing.assert_allclose(stage[*corner], GREYS[index], atol=3)
        margins = hw[0] / 2 - half_h, hw[1] / 2 - half_w
        assert max(margins) > 12
        middle = hw[0] // 2, hw[1] // 2
        beside = stage[4, middle[1]] if margins[0] > margins[1] else stage[middle[0], 4]
        assert (np.abs(beside.astype(int) - GREYS[index]) > 10).any()
    tab.click("#show-pictures")
    assert (np.abs(tab.shot("#stage")[40, 640 - 312 // 2].astype(int) - GREYS[2]) > 10).any()


def test_key_points_lie_where_they_were_seen(open_page):
    (frame,) = frames(1)
    far = frame.hands["right"]._replace(keypoints_px=np.full((4, 21, 2), np.nan))
    far.keypoints_px[1, 4] = 30, 20
    tab = open_page([frame._replace(hands={"right": far})])
    tab.click("#cameras button:nth-of-type(3)")
    with_ring = tab.shot("#stage")
    tab.click("#show-keypoints")
    without = tab.shot("#stage")
    hw = with_ring.shape[:2]
    _, scale = through_camera(cameras()[1], hw)
    centre = [hw[0] / 2 + scale * (20 - 45), hw[1] / 2 + scale * (30 - 80)]
    rows, columns = np.nonzero(coloured(with_ring) & ~coloured(without))
    np.testing.assert_allclose([rows.mean() + 0.5, columns.mean() + 0.5], centre, atol=1)


def test_the_slider_moves_to_a_frame_and_play_goes_on(open_page):
    tab = open_page(frames(5, step_m=0.03, timed=True))
    assert "0000" in tab.text("#moment")
    first = coloured(tab.shot("#stage"))
    tab.click("#slider", (0.5, 0.5))
    assert "0006" in tab.text("#moment")
    assert "0.20 s" in tab.text("#moment")
    moved = coloured(tab.shot("#stage"))
    assert overlap(first, moved) < 0.7
    assert 0.8 < moved.sum() / first.sum() < 1.25
    tab.click("#forward")
    assert "0009" in tab.text("#moment")
    tab.js("speed.value = '4'; speed.dispatchEvent(new Event('change'))")
    tab.click("#play")
    seen = tab.js(
        """new Promise(done => {
          const names = new Set(), until = performance.now() + 1500;
          const look = () => {
            names.add(state.frame);
            if (names.size === 5 || performance.now() > until) done(names.size); else setTimeout(look, 5);
          };
          look();
        })"""
    )
    assert seen >= 3
    tab.click("#play")
    stopped = tab.text("#moment")
    assert tab.js("new Promise(done => setTimeout(() => done(state.playing), 300))") is False
    assert tab.text("#moment") == stopped


def test_hands_are_hidden_and_coloured_by_their_joints(open_page):
    (frame,) = frames(1)
    sigma = np.full(21, 0.001)
    sigma[17:] = 0.02
    tab = open_page([frame._replace(hands={"right": page_hand(sigma_m=sigma), "left": page_hand("left", 1)})])
    both = tab.shot("#stage")
    assert coloured(both, "left").sum() > 1000
    tab.click("#hands li:nth-child(2) input")
    alone = tab.shot("#stage")
    assert coloured(alone, "left").sum() < 50
    tab.click("#measures button:nth-child(2)")
    by_sigma = tab.shot("#stage").astype(int)
    view = initial_view(
        np.concatenate([hand(), hand("left", 1)]), np.stack([c.T_cam_from_world for c in cameras()])
    )
    K, T = view_camera(view, by_sigma.shape[:2])
    weights = joint_weights()
    px = project(K, T, hand())[0].astype(int)
    colour = by_sigma[px[:, 1], px[:, 0]]
    red = colour[:, 0] - colour[:, 1]
    assert np.median(red[weights[:, 17:].sum(-1) > 0.9]) > 60
    assert np.median(red[weights[:, 1:13].sum(-1) > 0.9]) < 0
    table = tab.text("#joints")
    assert "20.0" in table
    assert "1.0" in table


def test_the_free_view_turns_and_comes_back(open_page):
    tab = open_page(frames(1))
    before = tab.shot("#stage")
    tab.drag("#stage", 200, 40)
    turned = tab.shot("#stage")
    assert overlap(coloured(before), coloured(turned)) < 0.8
    tab.click("#cameras button:nth-of-type(2)")
    tab.key("Escape")
    np.testing.assert_array_equal(tab.shot("#stage"), turned)


def test_title_numbers_and_dark_windows(open_page):
    caption = Caption("my <take>", "engine: fit", {"frames": "2", "cameras": "4"})
    bridged = {"right": page_hand()._replace(bridged=True)}
    first, second = frames(2)
    tab = open_page([first._replace(hands=bridged), second], dark=True, caption=caption)
    assert tab.text("h1") == "my <take>"
    assert "4" in tab.text("#facts")
    assert "bridged" in tab.text("#hands")
    assert tab.shot("#stage")[5, -5].max() < 60


def test_a_camera_without_a_picture_does_not_keep_that_of_the_frame_before(open_page):
    first, second = frames(2)
    tab = open_page([first, PageFrame("b", second.hands, [None, *second.pictures[1:]])])
    tab.click("#cameras button:nth-of-type(2)")
    assert (tab.shot("#stage") == GREYS[0]).all(-1).mean() > 0.3
    tab.click("#forward")
    assert "no picture" in tab.text("#where")
    assert (tab.shot("#stage") == GREYS[0]).all(-1).mean() < 0.01
