"""The test sets of the tables: tars or raw folders, where they belong, and where to get them."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from poem_jax.data.frames import FrameSource
from poem_jax.data.released_sets import RELEASED
from poem_jax.mixture.recognise import NEED_MANO, Kind, source_at
from poem_jax.tables.places import Places

TARS_FROM = "the packed sets linked in the README of github.com/JubSteven/POEM-v2"
MANO_FROM = "MANO_RIGHT.pkl from mano.is.tue.mpg.de"


class Opened(NamedTuple):
    """A split that is here."""

    source: FrameSource
    where: str
    """Which files it is."""


class Tars(NamedTuple):
    """The authors' packed form of a split."""

    set: str
    """As in the names of its shards: `DexYCB`."""
    split: str
    folder: str
    """Below the folder of tars."""

    def shards(self, places: Places) -> list[Path]:
        """Return those that are here."""
        return sorted((places.tars / self.folder).glob(f"{self.set}_mv_{self.split}-*.tar"))

    @property
    def count(self) -> int:
        """Shards that were released."""
        return next(one.shards for one in RELEASED if (one.name, one.split) == (self.set, self.split))


class Raw(NamedTuple):
    """A split of a set as it is unpacked."""

    kind: Kind
    folder: str
    """Below the folder of raw sets."""
    split: str
    get: str
    """Who gives it out."""


@dataclass(frozen=True)
class Split:
    """A test set of the paper in the two forms that are read; tars go first."""

    title: str
    raw: Raw
    tars: Tars | None = None
    sequences: tuple[str, ...] | None = None
    """Of HO-3D's evaluation set; None = all."""

    def open(self, places: Places) -> Opened:
        """Open what is here.

        Raises:
            FileNotFoundError: nothing is; says what to download and where to put it.
            ValueError: what is here is damaged.
        """
        shards = [] if self.tars is None else self.tars.shards(places)
        if self.tars is not None and shards:
            from poem_jax.data.sources.released_tars import ReleasedTars

            mano = places.mano if places.mano.is_file() else None
            source = ReleasedTars(shards, split=self.tars.split, mano=mano)
            some = "" if len(shards) == self.tars.count else f" ({len(shards)} of {self.tars.count} shards)"
            return Opened(source, f"tars in {places.tars / self.tars.folder}{some}")
        root = places.raw / self.raw.folder
        if not root.is_dir() or (self.raw.kind in NEED_MANO and not places.mano.is_file()):
            raise FileNotFoundError(self.missing(places))
        return Opened(self._open_raw(root, places), f"{root}, {self.raw.split}")

    def missing(self, places: Places) -> str:
        """Say what to download, and where to put it."""
        ways = []
        if self.tars is not None:
            last = f"{self.tars.count - 1:06d}"
            name = f"{self.tars.set}_mv_{self.tars.split}-{{000000..{last}}}.tar"
            ways.append(f"{TARS_FROM}, as {places.tars / self.tars.folder / name}")
        mano = f" and {MANO_FROM} as {places.mano}" if self.raw.kind in NEED_MANO else ""
        ways.append(f"the raw set from {self.raw.get} in {places.raw / self.raw.folder}/{mano}")
        return f"{self.title}: download " + "; or ".join(ways)

    def _open_raw(self, root: Path, places: Places) -> FrameSource:
        mano = places.mano if places.mano.is_file() else None
        if self.raw.kind in (Kind.HO3D_V2, Kind.HO3D_V3) and self.raw.split.startswith("evaluation"):
            from poem_jax.data.sources.ho3d import HO3D

            version = self.raw.kind.removeprefix("ho3d-")
            return HO3D(
                root, split=self.raw.split, version=version, mano=places.mano, sequences=self.sequences
            )
        return source_at(root, self.raw.kind, split=self.raw.split, mano=mano).open()


@dataclass(frozen=True)
class OwnCapture:
    """A capture of the user's, with labels of a hand model or of joints alone."""

    title: str = "real recording"

    def open(self, places: Places) -> Opened:
        """Open it; errors as for `Split`."""
        from poem_jax.data.sources.captures import Captures

        if not places.capture.is_dir():
            raise FileNotFoundError(
                f"{self.title}: the paper's is not public; put a capture with labels of MANO's or of joints "
                f"(docs/captures.md, docs/data.md) in {places.capture}/, or name one with --dataset"
            )
        mano = places.mano if places.mano.is_file() else None
        return Opened(Captures(places.capture, mano=mano, joints_alone=True), str(places.capture))


_HO3D_FROM = "www.tugraz.at (HO-3D; see github.com/shreyashampali/ho3d)"
_LABELLED = f"{_HO3D_FROM}, with its evaluation_xyz.json and evaluation_verts.json,"
DEXYCB = Split(
    "DexYCB-Mv",
    Raw(Kind.DEXYCB, "DexYCB", "test", "dex-ycb.github.io"),
    Tars("DexYCB", "test", "DexYCB_mv"),
)
OAKINK = Split(
    "OakInk-Mv",
    Raw(Kind.OAKINK, "OakInk", "test", "oakink.net"),
    Tars("Oakink", "test", "Oakink_mv"),
)
HO3D = Split(
    "HO3D-Mv",
    Raw(Kind.HO3D_V3, "HO3D", "test", f"{_HO3D_FROM} and HO3D_v3_manual_test_gt of github.com/lixiny/POEM"),
    Tars("HO3D", "test", "HO3D_mv_test"),
)
INTERHAND = Split(
    "InterHand-Mv",
    Raw(Kind.INTERHAND, "InterHand2.6M", "val", "mks0601.github.io/InterHand2.6M"),
    Tars("Interhand", "val", "Interhand_mv"),
)
ARCTIC = Split(
    "ARCTIC-Mv",
    Raw(Kind.ARCTIC, "arctic", "val", "arctic.is.tue.mpg.de"),
    Tars("Arctic", "val_p1", "Arctic_mv"),
)
HO3D_V2_OFFICIAL = Split("HO-3D v2, official", Raw(Kind.HO3D_V2, "HO3D", "evaluation-mv", _LABELLED))
HO3D_V3_OFFICIAL = Split("HO-3D v3, official", Raw(Kind.HO3D_V3, "HO3D", "evaluation-mv", _LABELLED))
HO3D_SM1 = Split("HO-3D v2, SM1", Raw(Kind.HO3D_V2, "HO3D", "evaluation-mv", _LABELLED), sequences=("SM1",))
