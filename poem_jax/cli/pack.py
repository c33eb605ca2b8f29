"""`poem pack`."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from poem_jax.cli.messages import say, tells_what_is_left
from poem_jax.cli.options import Flag, OptionalFile, OptionalFolder

if TYPE_CHECKING:
    from tqdm import tqdm

    from poem_jax.data.frames import FrameSource

RawSet = Literal["dexycb", "ho3d-v2", "ho3d-v3", "oakink", "arctic", "interhand", "freihand"]


@dataclass(frozen=True)
class Pack:
    """Write a raw data set once into tar shards of the kind that POEM v2 was trained from.

    Stopped, the same command goes on where it was. Samples that cannot be used are left out and named.
    With --check DIR nothing is packed: the shards in DIR, copied there from anywhere, are compared with the
    checksums in their manifests.
    """

    name: Annotated[RawSet | None, tyro.conf.Positional] = None
    """Data set."""
    root: OptionalFolder = None
    """Folder of the data set."""
    out: OptionalFolder = None
    """Folder for the shards and their manifest, `SET_mv_SPLIT.manifest.json`."""
    check: OptionalFolder = None
    """Compare the shards in this folder with their manifests, and do nothing else."""
    mano: OptionalFile = None
    """The user's MANO_RIGHT.pkl; only oakink and freihand do without."""
    split: str | None = None
    """Split, as the data set calls it; without it the one that the paper trains on."""
    setup: str | None = None
    """Of dexycb (s0, s1, s3), oakink (SP2) and arctic (p1); without it the paper's."""
    workers: int = 1
    """Processes that read and write; the shards do not depend on it."""
    samples_per_shard: int = 256
    """Samples of the data set in each shard."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the shards and print how many samples they hold; or check those that are there."""
        if self.check is not None:
            self._check(self.check)
            return
        if self.name is None or self.root is None or self.out is None:
            raise ValueError("say what to pack: NAME, --root DIR and --out DIR; or --check DIR")
        self._pack(self.name, self.root, self.out)

    def _pack(self, name: RawSet, root: Path, out: Path) -> None:
        from tqdm import tqdm

        from poem_jax.data.pack import pack
        from poem_jax.io.writable import check_folder_is_writable
        from poem_jax.mixture.recognise import Kind, training_split

        start = time.perf_counter()
        check_folder_is_writable(out)
        split = self.split or training_split(Kind(name))
        say(f"listing {name} {split} in {root}")
        source, set_name = self._open(name, root, split)
        with (
            tells_what_is_left(out),
            tqdm(total=len(source), unit="sample", desc="packing") as bar,
        ):
            packed = pack(
                source,
                out,
                set_name=set_name,
                split=_RELEASED_SPLITS.get((name, split), split),
                mano=self.mano,
                samples_per_shard=self.samples_per_shard,
                workers=self.workers,
                progress=lambda done, _: _advance(bar, done),
            )
        print(f"{packed.samples} samples in {len(packed.shards)} shards in {out}")
        if packed.skipped:
            print(f"{len(packed.skipped)} samples were left out; {packed.manifest} names them")
        print(f"checksums and counts: {packed.manifest}")
        print(f"done in {time.perf_counter() - start:.1f} s")

    def _check(self, folder: Path) -> None:
        """Compare checksums.

        Raises:
            FileNotFoundError: There is no manifest.
            ValueError: Shards are missing or have changed, or another option was given.
        """
        from poem_jax.data.manifest import check_shards, read_manifest

        if self != Pack(check=folder, debug=self.debug):
            raise ValueError("--check DIR stands alone: it packs nothing")
        places = sorted(place for place in folder.glob("*.manifest.json") if not place.name.startswith("."))
        if not places:
            raise FileNotFoundError(
                f"no SET_mv_SPLIT.manifest.json in {folder}; give the folder of the shards"
            )
        problems = []
        for place in places:
            manifest = read_manifest(place)
            found = check_shards(manifest, folder)
            shards = [entry for entry in manifest.shards.values() if entry.samples]
            samples = sum(entry.samples for entry in shards)
            verdict = f"{len(found)} problems" if found else "all as packed"
            print(f"{place.name}: {len(shards)} shards, {samples} samples, {verdict}")
            problems += found
        if problems:
            raise ValueError(
                f"what is in {folder} is not what was packed: {'; '.join(problems)}. Copy those files anew, "
                "or repeat the command that packed them, which writes only them"
            )

    def _open(self, name: RawSet, root: Path, split: str) -> "tuple[FrameSource, str]":
        """Return the source, and what its tars are called."""
        match name:
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
            raise ValueError(f"{name} has no setups; leave --setup out")
        match name:
            case "interhand":
                from poem_jax.data.sources.interhand import InterHand

                return InterHand(root, split=split, mano=self._need_mano()), "Interhand"
            case "freihand":
                from poem_jax.data.sources.freihand import FreiHAND

                return FreiHAND(root, split=split, mano=self.mano), "Freihand"
            case "ho3d-v2" | "ho3d-v3":
                from poem_jax.data.sources.ho3d import HO3D

                version = name.removeprefix("ho3d-")
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
