"""Identical blocks in a row, their weights stacked.

At inference one `lax.scan` runs them: it compiles a block once instead of n times, and keeps XLA from
recomputing residual chains inside large fusions. XLA:CPU, however, runs the gradients of convolutions inside
a loop a hundred times slower than outside, so that training on a CPU unrolls the blocks.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx

from poem_jax.models.batch_norm import NormMode

_Carry = TypeVar("_Carry")


def stacked_axes(path: Sequence[str]) -> int:
    """Count the leading axes, one per `Stack` around it, of the array at `path` in a model's parameters."""
    blocks = [i for i, part in enumerate(path) if part == "blocks"]
    return sum(not path[i + 1].isdigit() for i in blocks)


class Stack(nnx.Module):
    """`num_blocks` blocks of one kind, each with its own weights, applied one after the other."""

    def __init__(
        self, make_block: Callable[[nnx.Rngs], nnx.Module], num_blocks: int, *, rngs: nnx.Rngs
    ) -> None:
        self.num_blocks = num_blocks
        self.blocks = nnx.split_rngs(splits=num_blocks)(nnx.vmap(make_block))(rngs)

    def __call__(self, x: _Carry, mode: NormMode) -> _Carry:
        """Apply the blocks in order."""
        training_on_cpu = mode.training and jax.default_backend() == "cpu"
        return self.unrolled(x, mode) if training_on_cpu else self.scanned(x, mode)

    def scanned(self, x: _Carry, mode: NormMode) -> _Carry:
        """Apply the blocks in a loop."""

        @nnx.scan(in_axes=(nnx.Carry, 0), out_axes=nnx.Carry)
        def run(carry: _Carry, block: Callable[..., _Carry]) -> _Carry:
            return block(carry, mode)

        return run(x, self.blocks)

    def unrolled(self, x: _Carry, mode: NormMode) -> _Carry:
        """Apply the blocks one by one."""
        graph, weights = nnx.split(self.blocks)
        states = []
        for i in range(self.num_blocks):
            block: Any = nnx.merge(graph, jax.tree.map(lambda stacked, i=i: stacked[i], weights))
            x = block(x, mode)
            states.append(nnx.state(block))
        nnx.update(self.blocks, jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
        return x
