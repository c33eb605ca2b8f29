"""`poem pack`."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from poem_jax.cli.messages import say, tells_what_is_left
from poem_jax.cli.options import Flag, Folder, OptionalFile

if TYPE_CHECKING:
    from tqdm import tqdm

    from poem_jax.data.frames import FrameSource

RawSet = Literal["dexycb", "ho3d-v2", "ho3d-v3", "oakink", "arctic", "interhand", "freihand"]


@dataclass(frozen=True)
class Pack:
    """Write a raw data set once into tar shards of the kind that POEM v2 was trained from.

    Stopped, the same command goes on where it was. Samples that cannot be used are left out and named.
    """

    name: Annotated[RawSet, tyro.conf.Positional]
    """Data set."""
    root: Folder
    """Folder of the data set."""
    out: Folder
    """Folder for the shards and their manifest, `SET_mv_SPLIT.manifest.json`."""
    mano: OptionalFile = None
    """The user's MANO_RIGHT.pkl; only oakink and freihand do without."""
    split: str = "train"
    """Split, as the data set calls it."""
    setup: str | None = None
    """Of dexycb (s0, s1, s3), oakink (SP2) and arctic (p1); without it the paper's."""
    workers: int = 1
    """Processes that read and write; the shards do not depend on it."""
    samples_per_shard: int = 256
    """Samples of the data set in each shard."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the shards and print how many samples they hold."""
        from tqdm import tqdm

        from poem_jax.data.pack import pack
        from poem_jax.io.writable import check_folder_is_writable

        start = time.perf_counter()
        check_folder_is_writable(self.out)
        say(f"listing {self.name} in {self.root}")
        source, set_name = self._open()
        with (
            tells_what_is_left(self.out),
            tqdm(total=len(source), unit="sample", desc="packing") as bar,
        ):
            packed = pack(
                source,
                self.out,
                set_name=set_name,
                split=_RELEASED_SPLITS.get((self.name, self.split), self.split),
                mano=self.mano,
                samples_per_shard=self.samples_per_shard,
                workers=self.workers,
                progress=lambda done, _: _advance(bar, done),
            )
        print(f"{packed.samples} samples in {len(packed.shards)} shards in {self.out}")
        if packed.skipped:
            print(f"{len(packed.skipped)} samples were left out; {packed.manifest} names them")
        print(f"checksums and counts: {packed.manifest}")
        print(f"done in {time.perf_counter() - start:.1f} s")

    def _open(self) -> "tuple[FrameSource, str]":
        """Return the source, and what its tars are called."""
        root, split = self.root, self.split
        match self.name:
            case "dexycb":
                from poem_jax.data.sources.dexycb import DexYCB

                setup, mano = self._setup("s0"), self._need_mano()
                return DexYCB(root, split=split, setup=setup, mano=mano), "DexYCB"
            case "oakink":
                from poem_jax.data.sources.oakink import OakInk

                return OakInk(root, split=split, setup=self._setup("SP2"), mano=self.mano), "Oakink"
            case "arctic":
                from poem_jax.data.sources.arctic import Arctic

                setup, mano = self._setup("p1"), self._need_mano()
                return Arctic(root, split=split, setup=setup, mano=mano), "Arctic"
        if self.setup is not None:
            raise ValueError(f"{self.name} has no setups; leave --setup out")
        match self.name:
            case "interhand":
                from poem_jax.data.sources.interhand import InterHand

                return InterHand(root, split=split, mano=self._need_mano()), "Interhand"
            case "freihand":
                from poem_jax.data.sources.freihand import FreiHAND

                return FreiHAND(root, split=split, mano=self.mano), "Freihand"
            case "ho3d-v2" | "ho3d-v3":
                from poem_jax.data.sources.ho3d import HO3D

                version = self.name.removeprefix("ho3d-")
                return HO3D(root, split=split, version=version, mano=self._need_mano()), "HO3D"

    def _setup(self, of_paper: str) -> str:
        return self.setup or of_paper

    def _need_mano(self) -> Path:
        if self.mano is None:
            raise ValueError(
                f"{self.name} stores poses, from which its vertices are made: give --mano MANO_RIGHT.pkl "
                "(from mano.is.tue.mpg.de)"
            )
        return self.mano


def _advance(bar: "tqdm", done: int) -> None:
    bar.update(done - bar.n)


_RELEASED_SPLITS = {("arctic", "train"): "train_p1", ("arctic", "val"): "val_p1"}
"""What the names of the released tars call splits that the data set calls otherwise."""
