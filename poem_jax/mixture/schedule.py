"""Which part of a mixture stands at which position of its endless stream, and which frame it gives there.

Random access without looking back. The stream is cut into blocks of a thousand positions; how many of a
block's positions a part has follows from its share alone, rounded so that every prefix of whole blocks is
exact to one sample, and chance only orders them. So the number of a part's samples before a position is known
in closed form, and a part can go through its frames in permutations: every frame once an epoch.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from poem_jax.typing import Array, Int

BLOCK = 1000
_UNIT = 2**40
_BLOCKS, _ORDER = 2001, 2002
"""Last parts of seeds, so that no two uses of chance share a stream."""


class Turn(NamedTuple):
    """What a position of the stream holds."""

    part: int
    number: int
    """How many samples of that part stand before it."""


class Schedule:
    """The order of a mixture's parts; a pure function of (shares, seed, position)."""

    def __init__(self, shares: tuple[float, ...], seed: int) -> None:
        """Take shares that sum to 1, each 0.001 or more."""
        edges = [round(_UNIT * float(edge)) for edge in np.cumsum(shares)]
        self._edges = (0, *edges[:-1], _UNIT)
        self._seed = seed

    def at(self, position: int) -> Turn:
        """Return the part at a position of the stream, and how often it came before.

        Raises:
            ValueError: a negative position.
        """
        if position < 0:
            raise ValueError(f"`position` must not be negative; got {position}")
        block, place = divmod(position, BLOCK)
        order = _block(self._edges, self._seed, block)
        part = int(order[place])
        before = _count(self._edges, part, block) + int(np.count_nonzero(order[:place] == part))
        return Turn(part, before)


def frame_at(seed: int, part: int, number: int, length: int, attempt: int = 0) -> int:
    """Return which of a part's `length` frames is its sample `number`.

    Every frame comes once in an epoch of `length` samples, in an order of that epoch. Where that frame is
    corrupt, attempt 1, 2, ... gives the ones that follow it there.
    """
    epoch, place = divmod(number, length)
    return int(_permutation(seed, part, epoch, length)[(place + attempt) % length])


def _count(edges: tuple[int, ...], part: int, blocks: int) -> int:
    """Samples of a part in the first `blocks` blocks."""
    high, low = (edges[part + 1] * blocks * BLOCK) // _UNIT, (edges[part] * blocks * BLOCK) // _UNIT
    return high - low


@lru_cache(maxsize=16)
def _block(edges: tuple[int, ...], seed: int, block: int) -> Int[Array, " position"]:
    counts = [_count(edges, part, block + 1) - _count(edges, part, block) for part in range(len(edges) - 1)]
    order = np.repeat(np.arange(len(counts)), counts)
    return np.random.default_rng((seed, block, 0, 0, _BLOCKS)).permutation(order)


@lru_cache(maxsize=16)
def _permutation(seed: int, part: int, epoch: int, length: int) -> Int[Array, " frame"]:
    rng = np.random.default_rng((seed, part, epoch, 0, _ORDER))
    return rng.permutation(np.arange(length, dtype=np.int32))
