"""How much the hands of a take tremble from frame to frame, before they were smoothed and after."""

import math
from collections import deque
from typing import Any

import numpy as np

from poem_jax.fitting.causal import bend
from poem_jax.typing import Array, Float


class Jitter:
    """Second differences of the joints, gathered while a take goes by.

    Of three frames spaced evenly that is x(t-1) - 2 x(t) + x(t+1), whatever the spacing twice the distance of
    the middle one from the straight way between its neighbours.
    """

    def __init__(self, hands: int) -> None:
        self._last: list[deque[tuple[float, Array]]] = [deque(maxlen=3) for _ in range(hands)]
        self._sums = np.zeros(2)
        self._count = 0

    def add(
        self,
        hand: int,
        time_s: float,
        before: Float[Array, "joint 3"] | None,
        after: Float[Array, "joint 3"] | None,
    ) -> None:
        """Take in the joints of a hand at a moment, metres; None = it was not seen, and the row is broken."""
        last = self._last[hand]
        if before is None or after is None:
            last.clear()
            return
        last.append((time_s, np.stack([before, after]).astype(np.float64)))
        if len(last) == 3:
            off, _ = bend(*last)
            self._sums += np.mean(np.sum((2 * off) ** 2, axis=-1), axis=-1)
            self._count += 1

    def figures(self) -> dict[str, Any]:
        """Return the root mean squares, millimetres; None = there were no three frames in a row."""
        if not self._count:
            return {"jitter_before_mm": None, "jitter_after_mm": None}
        before, after = (round(1000 * math.sqrt(value / self._count), 3) for value in self._sums)
        return {"jitter_before_mm": before, "jitter_after_mm": after}
