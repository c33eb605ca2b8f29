"""`poem inspect`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from poem_jax.cli.messages import say
from poem_jax.cli.options import Flag, OptionalFile

if TYPE_CHECKING:
    from poem_jax.data.frames import FrameSource, MultiViewFrame

Kinds = Literal[
    "tars", "capture", "dexycb", "ho3d-v2", "ho3d-v3", "oakink", "arctic", "interhand", "freihand"
]
SHEET = "contact_sheet.png"
"""Name of the sheet of a miniature, which lies beside it."""
_MANO = "MANO_RIGHT.pkl"


@dataclass(frozen=True)
class Inspect:
    """Tell what a data set holds - counts, views, fields - and draw a contact sheet of it.

    PATH is a tar, a folder or a pattern of tars ('DexYCB_mv_test-{000000..000003}.tar'), the folder of a raw
    data set, or a labelled capture; see docs/data.md. With --miniature a tiny stand-in of a data set is
    written to the folder --out, and inspected.
    """

    path: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")] = None
    """What to look at."""
    kind: Kinds | None = None
    """What PATH is; found out where it is not said."""
    split: str | None = None
    """Without it the training set; tars say theirs in their names, and need it where there are several."""
    mano: OptionalFile = None
    """Your MANO_RIGHT.pkl: raw sets need it for their vertices, tars for MANO's mean pose."""
    samples: int = 4
    """Samples to draw, spread over the whole."""
    out: OptionalFile = None
    """The contact sheet (PNG); without it nothing is drawn. With --miniature: the folder."""
    miniature: str | None = None
    """Write this miniature: dexycb, ho3d-v2, ..., freihand as they are unpacked, tars-dexycb, ... packed."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Open the source, print what it holds, and write the sheet."""
        from poem_jax.mixture.recognise import Kind, recognise, source_at

        if self.samples < 1:
            raise ValueError(f"--samples must be at least 1; got {self.samples}")
        if self.miniature is not None:
            self._inspect_miniature()
            return
        if self.path is None:
            raise ValueError("say what to inspect: PATH, or --miniature NAME")
        kind = recognise(self.path) if self.kind is None else Kind(self.kind)
        say(f"{self.path}: {kind}")
        source = source_at(self.path, kind, split=self.split, mano=self.mano).open()
        self._show(source, self.mano, self.out)

    def _inspect_miniature(self) -> None:
        from poem_jax.io.writable import check_folder_is_writable
        from poem_jax.miniatures.mano_stand_in import write_mano
        from poem_jax.miniatures.names import WRITERS
        from poem_jax.mixture.recognise import Kind, source_at

        name, out = self.miniature, self.out
        if name not in WRITERS:
            raise ValueError(f"--miniature must be one of {', '.join(WRITERS)}; got {name!r}")
        if self.path is not None or out is None:
            raise ValueError("--miniature goes without PATH, and needs --out DIR, the folder to write it to")
        check_folder_is_writable(out)
        planted = WRITERS[name](out)
        mano = write_mano(out / _MANO)
        say(f"wrote {len(planted)} samples to {out}")
        if name.startswith("tars-"):
            # In folders by set, as the authors' archives are unpacked.
            source = source_at(out / "*" / "*.tar", Kind.TARS, split=self.split or "train", mano=mano)
        else:
            source = source_at(out, Kind(name), split=self.split, mano=mano)
        self._show(source.open(), mano, out / SHEET)

    def _show(self, source: "FrameSource", mano: Path | None, sheet: Path | None) -> None:
        from poem_jax.data.frames import CorruptSampleError

        count = len(source)
        if not count:
            raise ValueError(f"{source.name} has no sample")
        frames, problems = [], []
        for index in _spread(count, self.samples):
            try:
                frames.append(source[index])
            except CorruptSampleError as error:
                problems.append(error)
        print(f"{source.name}: {count} samples of up to {source.max_views} views")
        for name, value in describe(frames).items():
            print(f"  {name:<8}{value}")
        for problem in problems:
            print(f"  corrupt {problem}")
        if not frames:
            raise ValueError(f"none of the {len(problems)} samples looked at can be used")
        if sheet is not None:
            self._draw(frames, mano, sheet)

    def _draw(self, frames: Sequence["MultiViewFrame"], mano: Path | None, sheet: Path) -> None:
        from poem_jax.hand.mano_file import load
        from poem_jax.io.writable import check_file_is_writable
        from poem_jax.viz.contact_sheet import write_contact_sheet

        check_file_is_writable(sheet, "--out")
        faces = None if mano is None else load(mano).faces
        write_contact_sheet(sheet, frames, faces=faces)
        print(f"  sheet   {sheet}")


def describe(frames: Sequence["MultiViewFrame"]) -> dict[str, str]:
    """Say what samples hold: number of samples looked at, views, sizes, fields, first key."""
    if not frames:
        return {}
    numbers = sorted({len(frame.images) for frame in frames})
    sizes = sorted({(int(w), int(h)) for frame in frames for w, h in frame.size_wh})
    names = list(dict.fromkeys(name for frame in frames for name in frame.view_names))
    fields = {
        name: sum(getattr(frame, name) is not None for frame in frames)
        for name in ("pose_cam", "shape", "box_px", "mirror_px", "dist")
    }
    have = [name if n == len(frames) else f"{name} ({n})" for name, n in fields.items() if n]
    lack = [name for name, n in fields.items() if not n]
    return {
        "looked": f"at {len(frames)}: {', '.join(frame.key for frame in frames[:3])}"
        + (", ..." if len(frames) > 3 else ""),
        "views": f"{_range(numbers)} a sample: {', '.join(names[:10])}"
        + (", ..." if len(names) > 10 else ""),
        "images": ", ".join(f"{w} x {h}" for w, h in sizes[:6]) + (", ..." if len(sizes) > 6 else ""),
        "fields": "K, T_cam_from_world, joints, vertices, key points"
        + "".join(f", {name}" for name in have)
        + (f"; without {', '.join(lack)}" if lack else ""),
    }


def _spread(count: int, wanted: int) -> list[int]:
    """Return up to `wanted` indices, evenly over `count`."""
    wanted = min(count, wanted)
    return [i * count // wanted for i in range(wanted)]


def _range(numbers: Sequence[int]) -> str:
    return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"
