"""Arrays that are stored with a model's weights and never trained."""

import jax
import numpy as np
from flax import nnx

from poem_jax.hand.model import HandModel


class Constant(nnx.Variable):
    """An array that is stored with the weights and never trained."""


class StaticArray(np.ndarray):
    """Indices or flags among the constants: an array to all who read it, but no leaf of a pytree, so that
    nothing differentiates, casts or traces it."""


jax.tree_util.register_pytree_node(
    StaticArray, lambda array: ((), _ByValue(array)), lambda by_value, _: by_value.array
)


class _ByValue:
    """What `jit` compares to know a static array again."""

    def __init__(self, array: StaticArray) -> None:
        self.array, self.key = array, (array.dtype.str, array.shape, array.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByValue) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


class HandConstants(nnx.Module):
    """The hand model's arrays, stored with the weights."""

    def __init__(self, hand: HandModel) -> None:
        for name, value in hand._asdict().items():
            setattr(self, name, Constant(np.asarray(value)))

    def model(self) -> HandModel:
        """Return them as a `HandModel`."""
        return HandModel(*(getattr(self, name)[...] for name in HandModel._fields))
