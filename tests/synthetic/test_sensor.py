import numpy as np
import pytest

from poem_jax.synthetic.config import SensorConfig
from poem_jax.synthetic.sensor import develop_picture, draw_exposures, warp_background


def draw(num_views, config=None, seed=0):
    return draw_exposures(config or SensorConfig(), np.random.default_rng(seed), num_views, 5, 256)


IDEAL = SensorConfig(
    gain=(1.0, 1.0),
    gamma=(1.0, 1.0),
    white_balance=0.0,
    blur_px=(0.0, 0.0),
    motion_probability=0.0,
    noise=(0.0, 0.0),
    jpeg_probability=0.0,
)


def test_first_views_do_not_depend_on_how_many_follow():
    for few, many in zip(draw(2), draw(6), strict=False):
        for a, b in zip(few, many, strict=True):
            np.testing.assert_array_equal(a, b)


def test_settings_stay_within_their_ranges():
    config = SensorConfig(motion_probability=0.5, jpeg_probability=0.5)
    exposures = draw(500, config)
    assert {e.motion_px for e in exposures} == {0, *range(config.motion_px[0], config.motion_px[1] + 1)}
    qualities = [e.jpeg_quality for e in exposures if e.jpeg_quality]
    assert 200 < len(qualities) < 300
    assert config.jpeg_quality[0] <= min(qualities)
    assert max(qualities) <= config.jpeg_quality[1]
    assert {e.background for e in exposures} == set(range(5))
    assert len({e.seed for e in exposures}) == 500


def test_an_ideal_sensor_keeps_the_light():
    light = np.random.default_rng(0).uniform(0, 1, (16, 16, 3)).astype(np.float32)
    np.testing.assert_allclose(develop_picture(light, draw(1, IDEAL)[0]), 255 * light, atol=1)


def test_blur_and_motion_keep_the_mean():
    light = np.zeros((33, 33, 3), np.float32)
    light[16, 16] = 1
    sharp = draw(1, IDEAL)[0]
    for exposure in (sharp._replace(blur_px=1.0), sharp._replace(motion_px=5, motion_angle=0.7)):
        picture = develop_picture(light * 0.999, exposure._replace(gains=np.full(3, 1.0)))
        assert 0 < picture.max() < 200
        assert picture.sum() == pytest.approx(3 * 255, rel=0.25)


def test_jpeg_keeps_colours_in_their_channels():
    light = np.zeros((32, 32, 3), np.float32)
    light[..., 0], light[..., 1] = 0.8, 0.3
    picture = develop_picture(light, draw(1, IDEAL)[0]._replace(jpeg_quality=90))
    np.testing.assert_allclose(picture.mean((0, 1)), [204, 76.5, 0], atol=5)


def test_backgrounds_reach_beyond_their_edges():
    texture = np.random.default_rng(0).integers(100, 256, (256, 256, 3), dtype=np.uint8)
    exposure = draw(1)[0]._replace(warp=np.array([[2.0, 0, -300], [0, 2.0, 500]]))
    behind, tones = warp_background(texture, exposure, (128, 128))
    assert behind.min() >= 100
    assert tones.shape == (256, 3)
    assert (np.diff(tones, axis=0) > 0).all()
