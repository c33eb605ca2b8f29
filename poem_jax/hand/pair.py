"""Both hands of a person: a hand model and its mirror image."""

from typing import NamedTuple

import numpy as np

from poem_jax.hand.model import HandModel, mirror


class Hands(NamedTuple):
    """The hand models of both sides."""

    right: HandModel
    left: HandModel

    def of(self, side: str) -> HandModel:
        """Return the model of a side."""
        return self.left if side == "left" else self.right

    def by_side(self) -> dict[str, HandModel]:
        """Return both models by their sides."""
        return {"right": self.right, "left": self.left}

    def other(self, side: str) -> HandModel:
        """Return the model of the opposite side."""
        return self.right if side == "left" else self.left


def hands_of(model: HandModel) -> Hands:
    """Return a hand and its mirror image."""
    reflected = HandModel(*(np.asarray(array) for array in mirror(model)))
    return Hands(reflected, model) if model.side == "left" else Hands(model, reflected)
