"""`--formats capture`: what is written is a capture from which samples for training can be read."""

import cv2
import numpy as np
import pytest

from poem_jax.capture import write
from poem_jax.capture.outputs.formats import Format
from poem_jax.capture.report import Clock
from poem_jax.capture.write import Style, write_results
from poem_jax.data.sources.captures import Captures
from tests.capture.outputs.conftest import HANDS


@pytest.fixture(autouse=True)
def no_page(monkeypatch):
    monkeypatch.setattr(write, "write_page", lambda path, *_, **__: path)


def run(planted, out, pictures):
    rng = np.random.default_rng(0)
    smooth = [np.full((180, 240, 3), value, np.uint8) for value in rng.integers(0, 255, 3)]
    frames = [frame._replace(images=tuple(smooth) if pictures else (None,) * 3) for frame in planted.frames]
    faces = {side: hand.faces for side, hand in HANDS.items()}
    style = Style(faces, False, True, planted.origin, HANDS, frozenset({Format.CAPTURE}))
    written = write_results(iter(frames), planted.take, out, style, Clock(), {"engine": "planted"})
    return written, smooth


def test_its_samples_are_the_hands_in_the_photographs(planted, tmp_path):
    take = planted()
    written, smooth = run(take, tmp_path, pictures=True)
    source = Captures(tmp_path / "capture")
    seen = written.arrays["valid"] & ~written.arrays["bridged"]
    assert 0 < len(source) == seen.sum() < written.arrays["valid"].sum(), (
        "hands that were bridged are no labels"
    )
    sample = source[0]
    joints = written.arrays["joints_world"][seen][0]
    centres = np.linalg.norm(sample.joints_cam.mean(1), axis=-1)
    T = take.take.rig.T_cam_from_world
    expected = np.linalg.norm(T[:, :3, :3] @ (joints.mean(0) - take.origin) + T[:, :3, 3], axis=-1)
    np.testing.assert_allclose(centres, expected[: len(centres)], rtol=1e-5)
    for image, colour in zip(sample.images, smooth, strict=False):
        stored = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_allclose(stored, colour, atol=3)


def test_a_take_without_photographs_makes_none(planted, tmp_path, caplog):
    run(planted(), tmp_path, pictures=False)
    assert "has no photographs" in caplog.text
    assert not (tmp_path / "capture").exists()
