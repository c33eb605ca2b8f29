"""Hands fitted to 2D key points in calibrated views: robust triangulation, residuals, solvers."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from poem_jax.fitting.kinematics import keypoint_model
    from poem_jax.fitting.observations import Observations
    from poem_jax.fitting.robust_triangulation import KeypointNoise, triangulate_robust
    from poem_jax.fitting.take import FitConfig, FitResult, fit_take, fit_take_adam

_HOME = {
    "FitConfig": "take",
    "FitResult": "take",
    "KeypointNoise": "robust_triangulation",
    "Observations": "observations",
    "fit_take": "take",
    "fit_take_adam": "take",
    "keypoint_model": "kinematics",
    "triangulate_robust": "robust_triangulation",
}

__all__ = [
    "FitConfig",
    "FitResult",
    "KeypointNoise",
    "Observations",
    "fit_take",
    "fit_take_adam",
    "keypoint_model",
    "triangulate_robust",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"poem_jax.fitting.{_HOME[name]}"), name)
    raise AttributeError(f"module 'poem_jax.fitting' has no attribute '{name}'")
