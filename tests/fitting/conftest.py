from functools import partial

import jax
import numpy as np
import pytest

from poem_jax.fitting.kinematics import KeypointModel, keypoint_model
from poem_jax.hand.model import HandModel
from poem_jax.hand.template import default_hand
from poem_jax.synthetic.keypoint_takes import draw_keypoint_take


@pytest.fixture(scope="session")
def model() -> KeypointModel:
    return keypoint_model(default_hand())


def as_float64(hand: HandModel) -> HandModel:
    return HandModel(*(a.astype(np.float64) if a.dtype.kind == "f" else a for a in hand))


@pytest.fixture
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def takes():
    """`takes(frames, views, noise_px, seed)` of the shipped right hand."""
    return partial(draw_keypoint_take, default_hand())


@pytest.fixture
def model64() -> KeypointModel:
    return keypoint_model(as_float64(default_hand()))
