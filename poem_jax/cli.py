"""`poem`: hands from calibrated images, on the command line.

Arguments are parsed before JAX is imported, so that help is quick and compiled programs can be kept between
runs. Wrong input ends in one line and exit code 2.
"""

import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    from poem_jax.capture.pipeline import Written

USAGE_ERROR = 2

_Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
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
    debug: _Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the results and print where they are."""
        written = _reconstruct(self.folder, self.rig, self.boxes, self.out, self.checkpoint)
        _print_files(written, self.out)
        _print_summary(written.report)


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


def _parse(arguments: Sequence[str] | None) -> Demo | Reconstruct:
    reconstruct = Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
    return tyro.cli(
        Annotated[Demo, tyro.conf.subcommand("demo")] | reconstruct,  # pyright: ignore[reportArgumentType]
        prog="poem",
        description="Metric 3D hands from any number of calibrated cameras.",
        args=arguments,
    )


def _reconstruct(
    folder: Path, rig: Path | None, boxes: Path | None, out: Path, checkpoint: Path | None
) -> "Written":
    from poem_jax.capture.pipeline import read_take, reconstruct

    return reconstruct(read_take(folder, rig, boxes), out, checkpoint=checkpoint)


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
    sys.exit(main())
