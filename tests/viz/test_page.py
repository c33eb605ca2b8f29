"""The page's file: whole, with nothing from elsewhere, and its numbers those that were given."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from poem_jax.viz import page as page_module
from poem_jax.viz.page import Caption, PageFrame, write_page
from tests.viz.pages import FACES, cameras, frames, hand, joint_weights, page_hand


class Tags(HTMLParser):
    """Collects what a page refers to, and the content of its scripts."""

    def __init__(self, html):
        super().__init__()
        self.references, self.scripts, self._script = [], [], None
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self._script = dict(attrs).get("type", "script") if tag == "script" else None
        self.references += [value for name, value in attrs if name in ("src", "href", "action", "data")]

    def handle_data(self, data):
        if self._script:
            self.scripts.append((self._script, data))

    def handle_endtag(self, tag):
        self._script = None


def data_of(path):
    (data,) = [text for kind, text in Tags(path.read_text()).scripts if kind == "application/json"]
    return json.loads(data)


def array_of(data, name):
    stored = data["arrays"][name]
    whole = np.frombuffer(base64.b64decode(stored["numbers"]), "<i2").reshape(stored["shape"])
    return np.where(whole == -(2**15), np.nan, stored["offset"] + stored["step"] * whole.astype(float))


def test_one_self_contained_file(tmp_path):
    single = write_page(tmp_path / "one" / "index.html", frames(1), cameras(), FACES)
    take = write_page(tmp_path / "take.html", frames(4), cameras(), FACES)
    assert single.stat().st_size < 100_000
    assert single.stat().st_size < take.stat().st_size < 160_000
    html = single.read_text()
    assert Tags(html).references == ["data:,"]
    assert "default-src 'none'" in html
    assert not re.search(r"https?:|@import|url\(", html.replace("data:,", ""))
    assert [path.name for path in single.parent.iterdir()] == ["index.html"]


def test_a_long_take_of_eight_cameras_stays_small(tmp_path):
    """Without its pictures, for which their size is chosen by the frames there are."""
    eight = [camera._replace(name=f"c{i}") for i, camera in enumerate(2 * cameras())]
    both = {
        name: page_hand(name)._replace(keypoints_px=None, error_px=np.ones((8, 21)))
        for name in ("right", "left")
    }
    take = [PageFrame(f"{i}", both, [None] * 8) for i in range(120)]
    path = write_page(tmp_path / "p.html", take, eight, FACES, joint_weights=joint_weights())
    assert path.stat().st_size < 2.2e6


def test_numbers_come_back_as_they_were(tmp_path):
    first, second, third = frames(3, timed=True)
    left = page_hand("left", 1, confidence=np.linspace(0, 1, 84).reshape(4, 21))._replace(bridged=True)
    seen = np.array(left.keypoints_px)
    seen[2, 5] = np.nan
    second = second._replace(
        hands={"right": second.hands["right"], "left_0": left._replace(keypoints_px=seen)}
    )
    second = second._replace(pictures=[None, *second.pictures[1:]])
    caption = Caption("a </script> & b", "<i>", {"frames": "3"})
    path = write_page(tmp_path / "p.html", [first, second, third], cameras(), FACES, caption=caption)
    data = data_of(path)
    assert (data["title"], data["subtitle"], data["facts"]) == (caption.title, "<i>", [["frames", "3"]])
    assert "<title>a &lt;/script&gt; &amp; b</title>" in path.read_text()
    assert [hand["side"] for hand in data["hands"]] == ["right", "left"]
    assert data["frames"] == ["0000", "0003", "0006"]
    assert data["times_s"] == [0.0, 0.1, 0.2]
    assert data["bridged"] == [[False, False], [False, True], [False, False]]
    vertices = array_of(data, "vertices_world")
    np.testing.assert_allclose(vertices[1, 1], left.vertices_world, atol=2e-5)
    np.testing.assert_allclose(vertices[2, 0], third.hands["right"].vertices_world, atol=2e-5)
    assert np.isnan(vertices[[0, 2], 1]).all()
    np.testing.assert_allclose(array_of(data, "keypoints_px")[1, 1], seen, atol=1 / 16)
    np.testing.assert_allclose(array_of(data, "sigma_m")[0, 0], 0.003)
    np.testing.assert_allclose(array_of(data, "confidence")[1, 1], left.confidence, atol=5e-4)
    assert np.isnan(array_of(data, "confidence")[:, 0]).all()
    assert data["pictures"][1][0] is None
    assert base64.b64decode(data["pictures"][2][3]) == third.pictures[3]


def test_what_nobody_knows_is_left_out(tmp_path):
    (only,) = frames(1)
    bare = only.hands["right"]._replace(error_px=None, sigma_m=None, keypoints_px=None)
    path = write_page(tmp_path / "p.html", [only._replace(hands={"right": bare})], cameras(), FACES)
    arrays = data_of(path)["arrays"]
    assert {name for name, stored in arrays.items() if stored} == {"vertices_world", "joints_world"}


@pytest.mark.parametrize("times", [(0.0, None, 0.2), (0.0, 0.2, 0.1), (0.0, 0.1, np.nan), (0.0, 0.1, 0.1)])
def test_times_that_do_not_go_forward_are_not_shown(tmp_path, times):
    take = [frame._replace(time_s=time) for frame, time in zip(frames(3), times, strict=True)]
    assert data_of(write_page(tmp_path / "p.html", take, cameras(), FACES))["times_s"] is None


def test_what_lies_beyond_sixteen_bits_goes_to_their_end(tmp_path):
    (only,) = frames(1)
    far = only.hands["right"]._replace(error_px=np.full((4, 21), 1e6))
    path = write_page(tmp_path / "p.html", [only._replace(hands={"right": far})], cameras(), FACES)
    assert (array_of(data_of(path), "error_px") > 600).all()


def test_hands_may_come_and_go(tmp_path):
    nobody, right = PageFrame("a", {}, [None] * 4), frames(1)[0]
    path = write_page(tmp_path / "p.html", [nobody, right, nobody], cameras(), FACES)
    vertices = array_of(data_of(path), "vertices_world")
    assert np.isfinite(vertices).all(axis=(1, 2, 3)).tolist() == [False, True, False]
    with pytest.raises(ValueError, match="no frame holds a hand"):
        write_page(tmp_path / "none.html", [nobody], cameras(), FACES)
    with pytest.raises(ValueError, match="at least one frame"):
        write_page(tmp_path / "none.html", [], cameras(), FACES)
    with pytest.raises(ValueError, match=r"frame '0000' must have one picture.*4 cameras; got 3"):
        write_page(tmp_path / "none.html", [right._replace(pictures=[None] * 3)], cameras(), FACES)
    assert not (tmp_path / "none.html").exists()


def test_a_page_of_nobody_needs_a_view(tmp_path):
    view = page_module.initial_view(hand(), np.stack([camera.T_cam_from_world for camera in cameras()]))
    path = write_page(tmp_path / "p.html", [PageFrame("a", {}, [None] * 4)], cameras(), FACES, view=view)
    assert data_of(path)["hands"] == []
