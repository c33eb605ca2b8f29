"""Endless synthetic multi-view captures with exact ground truth."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from poem_jax.synthetic.config import SyntheticConfig
    from poem_jax.synthetic.dataset import SyntheticDataset

_HOME = {"SyntheticConfig": "config", "SyntheticDataset": "dataset"}

__all__ = ["SyntheticConfig", "SyntheticDataset"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"poem_jax.synthetic.{_HOME[name]}"), name)
    raise AttributeError(f"module 'poem_jax.synthetic' has no attribute '{name}'")
