"""`poem import-torch`."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from poem_jax.cli.messages import tells_what_is_left
from poem_jax.cli.options import File, Flag, Folder, OptionalFolder


@dataclass(frozen=True)
class ImportTorch:
    """Turn weights that POEM's authors released into a model folder; see docs/weights.md.

    Reads the PyTorch file without PyTorch and runs nothing that is in it.
    """

    checkpoint: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CKPT")]
    """The released .pth.tar."""
    variant: Literal[
        "v2-small",
        "v2-medium",
        "v2-large",
        "v2-medium-mano",
        "v1",
        "v1-g-emb",
        "v1-gv-emb",
        "v1-full-emb",
        "v1-wo-proj",
        "pe-meshtr",
        "ftl-meshtr",
        "mvp",
    ]
    """Which of the released models it is."""
    mano: File
    """MANO_RIGHT.pkl from mano.is.tue.mpg.de, or an npz with MANO's names."""
    out: Folder
    """Folder to make for the model."""
    assets: OptionalFolder = None
    """The folder assets of the authors' repository: bps.npy, anchor.npy, anchor_idx.npy; for POEM v2 alone,
    which needs it."""
    dataset: Annotated[
        Literal["dexycb", "ho3d", "oakink"] | None, tyro.conf.arg(metavar="{dexycb,ho3d,oakink}")
    ] = None
    """What a model of POEM v1 or a baseline was trained on; without it dexycb."""
    num_views: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Views that the layers of an MvP are made for; without it those of the data set: 8, 5, 4."""
    accept_anchors: Flag = False
    """Take anchors that do not lie on the template of the hand."""
    overwrite: Flag = False
    """Replace the model at --out."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the model and print what it was made of."""
        from poem_jax.io.writable import check_folder_is_writable
        from poem_jax.weights.release_files import import_release

        start = time.perf_counter()
        check_folder_is_writable(self.out)
        with tells_what_is_left(self.out):
            found = import_release(
                self.checkpoint,
                self.variant,
                mano=self.mano,
                out=self.out,
                assets=self.assets,
                dataset=self.dataset,
                num_views=self.num_views,
                accept_anchors=self.accept_anchors,
                overwrite=self.overwrite,
            )
        print(f"{found.model}: {found.num_parameters:,} parameters")
        print(f"{found.num_read} arrays read, {found.num_ignored} ignored, for no output depends on them")
        print(f"written to {self.out} in {time.perf_counter() - start:.1f} s; now try")
        print(f"poem reconstruct CAPTURE --out out/ --checkpoint {self.out}")
