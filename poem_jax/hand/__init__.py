"""The hand in MANO's schema: topology, model, files, and the template that ships."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from poem_jax.hand.mano_file import load
    from poem_jax.hand.model import HandMesh, HandModel, hand_mesh, joints_from_vertices, mirror, mirror_pose
    from poem_jax.hand.template import default_hand

_HOME = {
    "HandMesh": "model",
    "HandModel": "model",
    "default_hand": "template",
    "hand_mesh": "model",
    "joints_from_vertices": "model",
    "load": "mano_file",
    "mirror": "model",
    "mirror_pose": "model",
}

__all__ = [
    "HandMesh",
    "HandModel",
    "default_hand",
    "hand_mesh",
    "joints_from_vertices",
    "load",
    "mirror",
    "mirror_pose",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"poem_jax.hand.{_HOME[name]}"), name)
    raise AttributeError(f"module 'poem_jax.hand' has no attribute '{name}'")
