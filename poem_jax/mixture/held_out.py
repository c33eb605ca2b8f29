"""Frames that a run never trains on: the last ones of every take of a source.

Neighbours in a take look alike, so what is held out is contiguous: the end of each capture, shard, or of the
whole list where a source does not tell its takes apart. All hands of an instant go the same way where the
source tells instants (captures). Released tars and raw sets have each sample as its own instant: of a
handover's two people, or of two hands, one may be trained on and the other held out.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from poem_jax.data.frames import CorruptSampleError, DamagedSource, FrameSource, MultiViewFrame, TakesSource
from poem_jax.typing import Array, Int


class Subset:
    """Some frames of a source, as a source; a `FrameSource`."""

    def __init__(self, source: FrameSource, indices: Int[Array, " frame"]) -> None:
        self._source, self._indices = source, indices
        self.name, self.max_views = source.name, source.max_views

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, index: int) -> MultiViewFrame:
        """Read a frame; see `FrameSource`."""
        return self._source[int(self._indices[index])]

    def fingerprint(self) -> Mapping[str, str]:
        """Return that of the whole source."""
        return self._source.fingerprint()

    @property
    def faults(self) -> Sequence[CorruptSampleError]:
        """Those of the whole source; see `DamagedSource`."""
        return self._source.faults if isinstance(self._source, DamagedSource) else ()

    @property
    def lost_samples(self) -> int:
        """Of the whole source; see `DamagedSource`."""
        return self._source.lost_samples if isinstance(self._source, DamagedSource) else 0


def hold_out(source: FrameSource, share: float) -> tuple[Subset, Subset]:
    """Divide a source into what is trained on and what is held out.

    Args:
        source: the source.
        share: of the instants of every take, rounded, and at least one where a take has two; the last ones.

    Returns:
        Frames to train on, and held-out frames.

    Raises:
        ValueError: one of the two would have no frame.
    """
    takes = source.takes if isinstance(source, TakesSource) else _one_take(len(source))
    instants, instant_of = np.unique(takes, axis=0, return_inverse=True)
    _, first, sizes = np.unique(instants[:, 0], return_index=True, return_counts=True)
    # A short take rounds to none, but no take with a second instant goes unwatched.
    trained = np.array([size - max(round(share * size), min(size - 1, 1)) for size in sizes.tolist()])
    place = np.arange(len(instants)) - np.repeat(first, sizes)
    held = (place >= np.repeat(trained, sizes))[instant_of.reshape(-1)]
    if held.all() or not held.any():
        raise ValueError(
            f"`held_out` {share:g} of {source.name} leaves "
            f"{'nothing to train on' if held.all() else 'nothing to validate on'}: its {len(sizes)} takes "
            f"have up to {sizes.max()} instants each. Choose another share"
        )
    return Subset(source, np.flatnonzero(~held)), Subset(source, np.flatnonzero(held))


def _one_take(count: int) -> Int[Array, "sample 2"]:
    return np.stack([np.zeros(count, np.int64), np.arange(count)], -1)
