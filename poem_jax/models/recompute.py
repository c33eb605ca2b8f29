"""Rows of blocks whose insides can be computed again in the backward pass, instead of being kept for it.

Only what goes into a block is then kept: less memory, for the time of one more forward pass; the gradients
are the same. `recompute` switches it on in a model that was just assembled.
"""

from collections.abc import Callable
from typing import Any

import jax
from flax import nnx


class Row(nnx.Module):
    """What calls blocks one after the other."""

    recomputed = False
    """Whether the insides of its blocks are computed again."""

    def run(self, block: Callable[..., Any], *args: Any) -> Any:
        """Call a block, a module; a row among the blocks decides about its own."""
        if not self.recomputed or isinstance(block, Row):
            return block(*args)
        return nnx.remat(lambda block: block(*args))(block)

    def lean(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of arrays that keeps none of its inside, or as it is."""
        return jax.checkpoint(function) if self.recomputed else function  # pyright: ignore[reportPrivateImportUsage]


class TrunkRow(Row):
    """A row in what is done with every view alone."""


class DecoderRow(Row):
    """A row in what joins the views to a hand."""


def recompute(model: object, kinds: tuple[type[Row], ...]) -> None:
    """Let all rows of these kinds compute the insides of their blocks again."""
    for _, part in nnx.iter_graph(model) if kinds else ():
        if isinstance(part, kinds):
            part.recomputed = True
