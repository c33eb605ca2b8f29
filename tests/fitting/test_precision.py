"""On accelerators, too, no product of a fit is rounded to the bits of bfloat16 or TF32."""

from functools import partial

import jax.numpy as jnp
import pytest

from poem_jax.fitting import FitConfig, fit_take, fit_take_adam
from poem_jax.fitting.adam import ADAM_300_RELEASE
from poem_jax.fitting.kinematics import pose_jacobian, pose_keypoints, shape_jacobian
from poem_jax.fitting.smooth import SmoothConfig
from tests.fitting.observed import observed
from tests.precision import coarse_products


def test_key_points_and_their_derivatives(model):
    def all_of(model, pose, shape):
        posed = pose_keypoints(model, pose, shape)
        return posed.points, pose_jacobian(model, posed, pose), shape_jacobian(model, posed)

    assert not coarse_products(all_of, model, jnp.zeros((2, 16, 3)), jnp.zeros((2, 10)))


@pytest.mark.parametrize(
    "solver",
    [
        partial(fit_take, config=FitConfig(smooth=SmoothConfig())),
        partial(fit_take_adam, recipe=ADAM_300_RELEASE),
    ],
    ids=["lm", "adam"],
)
def test_whole_fits(model, takes, solver):
    assert not coarse_products(solver, model, observed(takes(2, 3, 1.0, 1)))
