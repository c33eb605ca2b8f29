"""On accelerators, too, no product of a fit is rounded to the bits of bfloat16 or TF32."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
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


SOLVERS = pytest.mark.parametrize(
    "solver",
    [
        partial(fit_take, config=FitConfig(smooth=SmoothConfig())),
        partial(fit_take_adam, recipe=ADAM_300_RELEASE),
    ],
    ids=["lm", "adam"],
)


@SOLVERS
def test_whole_fits(model, takes, solver):
    assert not coarse_products(solver, model, observed(takes(2, 3, 1.0, 1)))


@SOLVERS
def test_float32_and_float64_take_turns_in_one_process(model, model64, takes, solver):
    """JAX caches index arrays by identity: one of the default integer would keep its first precision."""
    take = observed(takes(2, 3, 1.0, 1))
    for x64, hand in ((False, model), (True, model64), (False, model)):
        dtype = np.float64 if x64 else np.float32
        cast = jax.tree.map(lambda a, dtype=dtype: a.astype(dtype) if a.dtype.kind == "f" else a, take)
        with jax.enable_x64(x64):
            fit = jax.eval_shape(lambda hand=hand, cast=cast: solver(hand, cast))
        assert fit.pose.dtype == dtype
