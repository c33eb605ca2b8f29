"""`poem`: hands from calibrated images, and the weights for it, on the command line.

Arguments are parsed before JAX is imported, so that help is quick and compiled programs can be kept between
runs. Wrong input ends in one line and exit code 2.
"""

import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from poem_jax.capture.results import Written
    from poem_jax.hand.model import HandModel

USAGE_ERROR = 2

_Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
_File = Annotated[Path, tyro.conf.arg(metavar="FILE")]
_Optional = Annotated[Path | None, tyro.conf.arg(metavar="PATH")]
_Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


@dataclass(frozen=True)
class Demo:
    """Reconstruct the bundled 4-camera capture and compare it with its ground truth."""

    out: _Folder = Path("out/demo")
    """Folder for the results."""
    checkpoint: _Optional = None
    """Model folder that poem_jax.save wrote; without it the shipped weights."""
    debug: _Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the results, print them and the error in millimetres."""
        from poem_jax.capture.demo import demo_folder, mpvpe_mm

        start = time.perf_counter()
        written = _reconstruct(demo_folder(), None, None, self.out, self.checkpoint)
        _print_files(written, self.out)
        print(f"\nMPVPE {mpvpe_mm(written.arrays):.1f} mm against the ground truth")
        print(f"done in {time.perf_counter() - start:.1f} s (the first run compiles the model)")


@dataclass(frozen=True)
class Reconstruct:
    """Reconstruct the hands of a capture: meshes, overlays, a 3D page, arrays and a report.

    DIR holds one image per camera, <camera>.jpg or .png, or frames/<frame>/<camera>.jpg for a take. Boxes or
    2D key points say where the hands are in each view; see docs/captures.md.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The capture."""
    out: _Folder
    """Folder for the results; files of the same name are replaced."""
    rig: _Optional = None
    """Calibration; without it rig.json or calibration/rig.json in DIR."""
    boxes: _Optional = None
    """Boxes or key points (npz); without it boxes.npz in DIR."""
    checkpoint: _Optional = None
    """Model folder that poem_jax.save wrote; without it the shipped weights."""
    engine: Literal["network", "fit"] = "network"
    """fit: no network, the hand model fitted to key points (then --boxes must hold them)."""
    mano: _Optional = None
    """With --engine fit, as for `poem fit`."""
    smooth: _Flag = False
    """With --engine fit, as for `poem fit`."""
    debug: _Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the results and print where they are."""
        if self.engine == "fit":
            if self.checkpoint is not None:
                raise ValueError("--checkpoint is for --engine network; a fit has no weights")
            from poem_jax.capture.fit import fit
            from poem_jax.capture.take import read_take

            take = read_take(self.folder, self.rig, self.boxes)
            written = fit(take, self.out, hand=_hand(self.mano), smooth=self.smooth)
        else:
            if self.mano is not None or self.smooth:
                raise ValueError("--mano and --smooth are for --engine fit; the network has its own hand")
            written = _reconstruct(self.folder, self.rig, self.boxes, self.out, self.checkpoint)
        _print_files(written, self.out)
        _print_summary(written.report)


@dataclass(frozen=True)
class Fit:
    """Fit hands to 2D key points from several calibrated cameras; no network, no images needed.

    Writes what `reconstruct` writes, with pose, shape and place of the hand model, and the uncertainty of
    every joint; see docs/fitting.md.
    """

    keypoints: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="KEYPOINTS")]
    """Key points (npz); see docs/captures.md."""
    rig: _File
    """Calibration."""
    out: _Folder
    """Folder for the results; files of the same name are replaced."""
    images: _Optional = None
    """Capture folder with the images to draw on."""
    mano: _Optional = None
    """MANO_RIGHT.pkl or MANO_LEFT.pkl, or an npz with MANO's names; without it the shipped hand."""
    smooth: _Flag = False
    """Hold the frames of a take together in a second pass."""
    debug: _Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the results and print where they are."""
        from poem_jax.capture.fit import fit, read_keypoint_take

        take = read_keypoint_take(self.keypoints, self.rig, self.images)
        written = fit(take, self.out, hand=_hand(self.mano), smooth=self.smooth)
        _print_files(written, self.out)
        _print_summary(written.report)


@dataclass(frozen=True)
class Detect:
    """Find both hands in the images of a capture with MediaPipe and write their 2D key points."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The capture, as for `reconstruct`."""
    out: _File
    """The key-point file (npz) to write, for `fit` or for `reconstruct --boxes`."""
    rig: _Optional = None
    """Calibration; without it rig.json or calibration/rig.json in DIR."""
    debug: _Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the file and print what was found."""
        import numpy as np

        from poem_jax.capture.boxes_file import write_boxes
        from poem_jax.capture.detect import detect_hands
        from poem_jax.capture.folder import find_frames
        from poem_jax.capture.rig_file import find_rig

        rig = find_rig(self.folder, self.rig)
        hands = detect_hands(find_frames(self.folder, rig.names), rig)
        write_boxes(self.out, hands)
        views = np.isfinite(hands.boxes_px).all(-1).sum(2)
        for side, count in zip(hands.hand_side, views.T, strict=True):
            print(f"{side} hand: seen by two views or more in {(count > 1).sum()} of {len(count)} frames")
        print(f"written to {self.out}")


@dataclass(frozen=True)
class ImportTorch:
    """Turn weights that POEM's authors released into a model folder; see docs/weights.md.

    Reads the PyTorch file without PyTorch and runs nothing that is in it.
    """

    checkpoint: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CKPT")]
    """The released .pth.tar."""
    variant: Literal["v2-small", "v2-medium", "v2-large", "v2-medium-mano"]
    """Which of the released models it is."""
    mano: _File
    """MANO_RIGHT.pkl from mano.is.tue.mpg.de, or an npz with MANO's names."""
    assets: _Folder
    """The folder assets of the authors' repository: bps.npy, anchor.npy, anchor_idx.npy."""
    out: _Folder
    """Folder to make for the model."""
    accept_anchors: _Flag = False
    """Take anchors that do not lie on the template of the hand."""
    overwrite: _Flag = False
    """Replace the model at --out."""
    debug: _Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the model and print what it was made of."""
        from poem_jax.weights.release_files import import_release

        start = time.perf_counter()
        found = import_release(
            self.checkpoint,
            self.variant,
            mano=self.mano,
            assets=self.assets,
            out=self.out,
            accept_anchors=self.accept_anchors,
            overwrite=self.overwrite,
        )
        print(f"{self.variant}: {found.num_parameters:,} parameters")
        print(f"{found.num_read} arrays read, {found.num_ignored} ignored, for no output depends on them")
        print(f"written to {self.out} in {time.perf_counter() - start:.1f} s; now try")
        print(f"poem reconstruct CAPTURE --out out/ --checkpoint {self.out}")


@dataclass(frozen=True)
class ExportTorch:
    """Turn a model folder back into a PyTorch state dict that the released code loads."""

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of a released model, such as import-torch writes."""
    out: _File
    """The .pth.tar to write."""
    overwrite: _Flag = False
    """Replace the file at --out."""
    debug: _Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the file and print how to open it."""
        from poem_jax.weights.release_files import export_release

        count = export_release(self.model, self.out, overwrite=self.overwrite)
        print(f"{count} arrays written to {self.out}; open it with")
        print(f"torch.load({str(self.out)!r}, weights_only=True)")


Command = Demo | Reconstruct | Fit | Detect | ImportTorch | ExportTorch


def start() -> int:
    """Run the `poem` command as installed: with the allocator that suits it, then `main`."""
    from poem_jax.io.allocator import restart_with_settings

    restart_with_settings()
    return main()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, or 2 with one line on standard error for wrong input."""
    logging.basicConfig(format="poem: %(message)s", level=logging.WARNING)
    command = _parse(arguments)
    from poem_jax.io.compilation_cache import use_compilation_cache

    use_compilation_cache()
    try:
        command.run()
    except (ValueError, OSError, ModuleNotFoundError) as error:
        if command.debug:
            raise
        print(f"poem: error: {error}", file=sys.stderr)
        return USAGE_ERROR
    return 0


def _parse(arguments: Sequence[str] | None) -> Command:
    commands = (
        Annotated[Demo, tyro.conf.subcommand("demo")]
        | Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
        | Annotated[Fit, tyro.conf.subcommand("fit")]
        | Annotated[Detect, tyro.conf.subcommand("detect")]
        | Annotated[ImportTorch, tyro.conf.subcommand("import-torch")]
        | Annotated[ExportTorch, tyro.conf.subcommand("export-torch")]
    )
    return tyro.cli(
        commands,  # pyright: ignore[reportArgumentType]
        prog="poem",
        description="Metric 3D hands from any number of calibrated cameras.",
        args=arguments,
    )


def _reconstruct(
    folder: Path, rig: Path | None, boxes: Path | None, out: Path, checkpoint: Path | None
) -> "Written":
    from poem_jax.capture.pipeline import reconstruct
    from poem_jax.capture.take import read_take

    return reconstruct(read_take(folder, rig, boxes), out, checkpoint=checkpoint)


def _hand(path: Path | None) -> "HandModel | None":
    from poem_jax.hand.mano_file import load

    return None if path is None else load(path)


def _print_files(written: "Written", out: Path) -> None:
    """List the files folder by folder; frames beyond the third in one line."""
    folders: dict[Path, list[str]] = {}
    for path in written.files:
        folders.setdefault(path.parent, []).append(path.name)
    frames = [folder for folder in folders if folder != out]
    for folder in frames[:3]:
        print(f"{folder}/  {'  '.join(folders[folder])}")
    if len(frames) > 3:
        print(f"... and {len(frames) - 3} more frames like these")
    print(f"{out}/  {'  '.join(folders.get(out, []))}")


def _print_summary(report: dict[str, Any]) -> None:
    reprojection = report["reprojection"]
    hands = [hand for frame in report["frames"] for hand in frame.get("hands", [])]
    solved = sum(hand["valid"] for hand in hands)
    print(f"\n{solved} of {len(hands)} hands in {len(report['frames'])} frames", end="")
    print(f", {report['failed_frames']} frames failed" if report["failed_frames"] else "")
    if reprojection["median_px"] is not None:
        print(f"reprojection error {reprojection['median_px']:.1f} px (median, {reprojection['against']})")
    print(f"done in {report['timings_s']['total']:.1f} s")


if __name__ == "__main__":
    sys.exit(start())
