"""The multi-view samples that the authors of POEM v2 packed into tars, and those that `poem pack` writes."""

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from poem_jax.data.frames import CorruptSampleError, EncodedImage, MultiViewFrame
from poem_jax.data.released_sets import count_problem, of_split, shard_name
from poem_jax.data.shards import ShardSet, expand_shards
from poem_jax.data.sources.hand_in_views import ManoFile
from poem_jax.data.tar_labels import convention_of, frame_from_label
from poem_jax.io.safe_pickle import loads_arrays_pickle
from poem_jax.typing import Array, Int

LABEL = "label.pyd"
_IMAGE = r"image_(\d+)\.(?:jpg|jpeg|png)"
_MAX_LABEL_BYTES = 2**26
"""A label of 8 views has 0.3 MB."""
_MOST_TOLD = 10
"""Faults that are logged; `faults` has all."""

_log = logging.getLogger(__name__)


class ReleasedTars:
    """One split of one data set in shards `SET_mv_SPLIT-NNNNNN.tar`; a `FrameSource`.

    Views come in the order of the tar, which is the master camera first where the data set has one. Frames
    are named `SHARD/KEY`, as the keys of a tar need not differ from those of the next.
    """

    def __init__(
        self,
        paths: str | Path | Sequence[str | Path],
        *,
        split: str | None = None,
        mano: str | Path | None = None,
        strict_counts: bool = False,
    ) -> None:
        """Open shards; their members are indexed when they are opened for the first time.

        Args:
            paths: A folder of shards, a pattern (`.../DexYCB_mv_train-{000000..000019}.tar`, or with `*`), a
                file, or a list of these.
            split: Which split, where shards of several are among them: `train` also means `train_p1` and
                `train+val`.
            mano: The user's MANO_RIGHT.pkl: with it ARCTIC's and InterHand2.6M's poses are read too, which
                are stored relative to MANO's mean pose.
            strict_counts: Raise where a whole set of shards has not the samples of the released one, instead
                of a warning.

        Raises:
            FileNotFoundError: Shards are missing.
            ValueError: Names that say no data set, shards of several splits, no whole sample, no MANO hand,
                or `strict_counts` and other counts.
        """
        shards = of_split(expand_shards(paths), split)
        names = [shard_name(path) for path in shards]
        self._convention = convention_of(shards[0].name)
        self._shards = ShardSet(shards, required=LABEL)
        self._mano = None if mano is None else ManoFile.open(mano)
        self.name = f"{names[0].set} tars {names[0].split}"
        self.max_views = self._shards.max_members(_IMAGE)
        if self._convention.pose_lacks_mean and self._mano is None:
            _log.info("%s: poses are left out; they need `mano`, the MANO file's mean pose", self.name)
        for fault in self.faults[:_MOST_TOLD]:
            _log.warning("left out of %s: %s", self.name, fault)
        if len(self.faults) > _MOST_TOLD:
            _log.warning("left out of %s: %d more", self.name, len(self.faults) - _MOST_TOLD)
        if (problem := count_problem(names, len(self))) is not None:
            if strict_counts:
                raise ValueError(f"{self.name} {problem}")
            _log.warning("%s %s", self.name, problem)

    @property
    def faults(self) -> list[CorruptSampleError]:
        """What was left out when the shards were opened: cut or empty shards, keys that come twice, samples
        without a label."""
        return self._shards.faults

    @property
    def lost_samples(self) -> int:
        """About how many samples the faults stand for; see `ShardSet`."""
        return self._shards.lost_samples

    @property
    def takes(self) -> Int[Array, "sample 2"]:
        """Return shard and place of each sample; see `TakesSource`."""
        return np.stack([self._shards.shards_of_samples, np.arange(len(self))], -1)

    def __len__(self) -> int:
        return len(self._shards)

    def __getitem__(self, index: int) -> MultiViewFrame:
        """Read a frame; see `FrameSource`.

        Raises:
            IndexError: There is no such frame.
            CorruptSampleError: Images or label are missing or damaged, or the label cannot be true.
        """
        path, tar_key = self._shards.locate(index)
        key = f"{path.stem}/{tar_key}"
        files = self._shards.read(index)
        images = _images(files, path, key)
        return frame_from_label(
            _label(files[LABEL], path, key), images, self._convention, path=path, key=key, mano=self._mano
        )

    def fingerprint(self) -> Mapping[str, str]:
        """Return name of each shard -> size, number of samples and a checksum of its index."""
        return self._shards.fingerprint()


def _images(files: Mapping[str, bytes], path: Path, key: str) -> list[EncodedImage]:
    """Return `image_0` to `image_{n - 1}`."""
    found = {}
    for suffix, data in files.items():
        if (match := re.fullmatch(_IMAGE, suffix)) is not None:
            number = int(match[1])
            if number in found:
                raise CorruptSampleError(path, key, f"image_{number} is there as {suffix} and another file")
            found[number] = EncodedImage(data, f"{path}: {key.rpartition('/')[2]}.{suffix}")
    if sorted(found) != list(range(len(found))) or not found:
        numbers = ", ".join(map(str, sorted(found))) or "none"
        raise CorruptSampleError(path, key, f"images must be numbered 0, 1, 2 ...; got {numbers}")
    return [found[number] for number in range(len(found))]


def _label(data: bytes, path: Path, key: str) -> object:
    if len(data) > _MAX_LABEL_BYTES:
        raise CorruptSampleError(path, key, f"{LABEL} has {len(data)} bytes, of at most {_MAX_LABEL_BYTES}")
    try:
        return loads_arrays_pickle(data, source=LABEL)
    except ValueError as error:
        raise CorruptSampleError(path, key, str(error)) from error
