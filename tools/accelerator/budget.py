"""The time that there is, and whether something still fits into it."""

import time


class Budget:
    """A clock that runs from the start; seconds."""

    def __init__(self, minutes: float) -> None:
        if not minutes > 0:
            raise ValueError(f"`--minutes` must be positive; got {minutes}")
        self._end = time.monotonic() + 60 * minutes

    def left(self, *, keep: float = 0.0) -> float:
        """Return the seconds left beside those that are kept for something else; never negative."""
        return max(self._end - time.monotonic() - keep, 0.0)
