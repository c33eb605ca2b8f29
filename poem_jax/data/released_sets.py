"""The tar files that were released: their names and how many there are; as far as known.

Written from the configurations and the evaluation script of POEM v2. Where the paper counts otherwise, both
numbers are here: DexYCB's test tars hold 4,950 frames, the paper has 4,951; OakInk's hold 21,351, the paper
19,909.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_NAME = re.compile(r"(?P<set>[^_]+)_mv_(?P<split>.+)-(?P<number>\d+)\.tar")


class ReleasedSplit(NamedTuple):
    """One split of one data set."""

    name: str
    split: str
    shards: int
    samples: int | None = None
    """None: not known."""
    paper: int | None = None
    """What the paper counts, where it differs."""


RELEASED = (
    ReleasedSplit("HO3D", "train", 9),
    ReleasedSplit("HO3D", "test", 3, 2706),
    ReleasedSplit("DexYCB", "train", 20),
    ReleasedSplit("DexYCB", "test", 4, 4950, paper=4951),
    ReleasedSplit("Arctic", "train_p1", 361),
    ReleasedSplit("Arctic", "val_p1", 46, 17392),
    ReleasedSplit("Interhand", "train", 76),
    ReleasedSplit("Interhand", "val", 23, 85255),
    ReleasedSplit("Oakink", "train+val", 104),
    ReleasedSplit("Oakink", "test", 46, 21351, paper=19909),
    ReleasedSplit("Freihand", "train", 5),
    ReleasedSplit("Freihand", "test", 1, 3960),
)


class ShardName(NamedTuple):
    """What the name of a shard says."""

    set: str
    split: str
    number: int


def shard_name(path: Path) -> ShardName:
    """Read the name of a shard, `DexYCB_mv_train-000000.tar`.

    Raises:
        ValueError: it is named otherwise.
    """
    match = _NAME.fullmatch(path.name)
    if match is None:
        raise ValueError(
            f"a shard must be named SET_mv_SPLIT-NUMBER.tar, as DexYCB_mv_train-000000.tar; got {path.name}"
        )
    return ShardName(match["set"], match["split"], int(match["number"]))


def of_split(paths: Sequence[Path], split: str | None) -> tuple[Path, ...]:
    """Return the shards of one split of one data set.

    Args:
        paths: shards.
        split: as in their names, or what it begins with (`train` for `train_p1` and `train+val`); None =
            there is one only.

    Raises:
        ValueError: shards of several sets or splits remain, or none.
    """
    found: dict[tuple[str, str], list[Path]] = {}
    for path in paths:
        name = shard_name(path)
        if split is None or split in (name.split, re.split(r"[_+]", name.split)[0]):
            found.setdefault((name.set, name.split), []).append(path)
    if len(found) == 1:
        return tuple(next(iter(found.values())))
    there = sorted({f"{name.set} {name.split}" for name in map(shard_name, paths)})
    what = f"of split {split!r} " if split is not None else ""
    raise ValueError(
        f"one split of one data set is read at a time; got {len(found)} {what}among shards of "
        f"{', '.join(there)}: give `split`, or fewer shards"
    )


def count_problem(names: Sequence[ShardName], samples: int) -> str | None:
    """Say how the number of samples differs from the released one; None: it does not, or cannot be told.

    Only a whole set of shards tells: numbers 0 to N - 1 with the released N.
    """
    for known in RELEASED:
        if (known.name, known.split) != names[0][:2] or known.samples in (None, samples):
            continue
        if sorted(name.number for name in names) == list(range(known.shards)):
            paper = f" (the paper: {known.paper})" if known.paper else ""
            return f"has {samples} samples in {known.shards} shards; the released tars {known.samples}{paper}"
    return None
