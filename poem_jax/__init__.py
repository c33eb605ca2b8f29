"""poem_jax: metric 3D hands from any number of calibrated cameras.

The public surface is lazy: importing the package imports neither JAX nor Flax, so data workers stay light.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from poem_jax.batch import MultiViewBatch, Prediction
    from poem_jax.geometry.cameras import Cameras
    from poem_jax.hand.model import HandModel
    from poem_jax.models.apply import apply, init
    from poem_jax.models.infer import Prepared, infer, prepare
    from poem_jax.models.presets import preset
    from poem_jax.weights.store import load, save

_HOME = {
    "Cameras": "poem_jax.geometry.cameras",
    "HandModel": "poem_jax.hand.model",
    "MultiViewBatch": "poem_jax.batch",
    "Prediction": "poem_jax.batch",
    "Prepared": "poem_jax.models.infer",
    "apply": "poem_jax.models.apply",
    "infer": "poem_jax.models.infer",
    "init": "poem_jax.models.apply",
    "load": "poem_jax.weights.store",
    "prepare": "poem_jax.models.infer",
    "preset": "poem_jax.models.presets",
    "save": "poem_jax.weights.store",
}
_ROOMS = (
    "calibration",
    "detection",
    "evaluation",
    "experiments",
    "fitting",
    "geometry",
    "hand",
    "models",
    "synthetic",
)

__version__ = "0.1.0"
__all__ = [
    "Cameras",
    "HandModel",
    "MultiViewBatch",
    "Prediction",
    "Prepared",
    "apply",
    "infer",
    "init",
    "load",
    "prepare",
    "preset",
    "save",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    if name in _ROOMS:
        return importlib.import_module(f"poem_jax.{name}")
    raise AttributeError(f"module 'poem_jax' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME, *_ROOMS])
