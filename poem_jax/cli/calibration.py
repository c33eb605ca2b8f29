"""`poem calibration`: check a calibration, write it in another format, refine it from the hands."""

import math
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from poem_jax.capture.calibration_report import CheckReport
    from poem_jax.capture.timing import Timing

from poem_jax.cli.messages import say
from poem_jax.cli.options import File, Flag, MomentOptions, Moments, OptionalFile, OptionalFolder

_BY_SIDE = "keypoints_by_side.npz"
FAULTY = 1
"""Exit code of a check that found something."""
PositionalRig = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RIG")]


@dataclass(frozen=True)
class Check:
    """Find out what is wrong with a calibration, and say the likely cause and the fix.

    Key points of hands, given or found in the images, tell most; without them only what the rig shows by
    itself is said. Exit code 0: nothing is wrong; 1: something is.
    """

    rig: PositionalRig
    """Calibration, of any format that is read."""
    keypoints: OptionalFile = None
    """2D key points of hands (npz), as `poem detect` writes them."""
    images: OptionalFolder = None
    """Capture folder whose images are searched for hands first, and drawn on."""
    videos: OptionalFolder = None
    """Folder of one video per camera, likewise."""
    max_hands: int = 2
    """Hands that are looked for."""
    video: Flag = False
    """As for `poem detect`."""
    moments: MomentOptions = Moments()
    out: OptionalFolder = None
    """Folder for report.json, rig.png, and pictures with the key points where there are images."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> int:
        """Print a line for each finding, and return the exit code."""
        from poem_jax.calibration.view_agreement import UNEXPLAINED
        from poem_jax.capture.calibration_report import check_files

        footage = self.images or self.videos
        if self.images is not None and self.videos is not None:
            raise ValueError("give --images or --videos, not both")
        timing = self.moments.timing()
        report = check_files(self.rig, self._keypoints(footage), footage, self.out, timing)
        if self.keypoints is None and {finding.name for finding in report.findings} & set(UNEXPLAINED):
            report = self._second_look(footage, timing, report)
        for finding in report.findings:
            print(f"{finding.name}: {finding}")
        if not report.findings:
            print(report.summary)
        if self.out is not None:
            say(f"pictures and report in {self.out}")
        return FAULTY if report.findings else 0

    def _keypoints(self, footage: Path | None) -> Path | None:
        """Return the given file; else search the images or videos, and write what was found."""
        if self.keypoints is not None or footage is None:
            return self.keypoints
        if self.out is None:
            raise ValueError(
                "--images and --videos are searched for hands, and the key points are written to the folder "
                "--out; pass --out DIR, or the key points by --keypoints"
            )
        from poem_jax.cli.detect import find_keypoints
        from poem_jax.io.writable import check_folder_is_writable

        check_folder_is_writable(self.out)
        self.out.mkdir(parents=True, exist_ok=True)
        found = self.out / _BY_SIDE
        find_keypoints(footage, found, self.rig, 2, self.video, self.moments, by_side=True)
        return found

    def _second_look(self, footage: Path | None, timing: "Timing", report: "CheckReport") -> "CheckReport":
        """Where hands told apart by their sides do not fit, and no mistake says why, judge them as the rig
        puts them together: a detector that mistakes sides, or several people, is not the rig's fault."""
        from poem_jax.capture.calibration_report import check_files
        from poem_jax.cli.detect import FOUND_FILE, SEARCH_SUFFIX, find_keypoints

        assert footage is not None
        assert self.out is not None
        found, searched = self.out / FOUND_FILE, (self.out / _BY_SIDE).with_suffix(SEARCH_SUFFIX)
        if searched.is_file():
            shutil.copyfile(searched, found.with_suffix(SEARCH_SUFFIX))
        try:
            find_keypoints(footage, found, self.rig, self.max_hands, self.video, self.moments)
        except ValueError:
            return report
        second = check_files(self.rig, found, footage, self.out, timing)
        return report if second.findings else second


@dataclass(frozen=True)
class Convert:
    """Read a calibration of any known format and write it in another."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IN")]
    """Calibration file, or a folder such as COLMAP's."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """File or folder to write."""
    format: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Name of the format to write; without it what the ending of OUT says."""
    unit: Annotated[str | None, tyro.conf.arg(metavar="UNIT")] = None
    """Unit of the lengths in IN, whatever it says: metre, centimetre, millimetre, inch, or the metres of
    one unit."""
    image_size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="W H")] = None
    """Width and height of all images, for formats that do not hold them."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> int:
        """Write the calibration and say what it holds."""
        from poem_jax.calibration.read_calibration import read_calibration
        from poem_jax.calibration.write_calibration import FORMATS, files_written, write_calibration

        if self.format is not None and self.format not in FORMATS:
            raise ValueError(f"--format must be one of {', '.join(FORMATS)}; got {self.format!r}")
        rig = read_calibration(self.source, unit=self.unit, image_size=self.image_size)
        self._check_source_stays(files_written(self.out, rig, self.format))
        written = write_calibration(self.out, rig, self.format)
        print(f"{rig.num_views} cameras ({', '.join(rig.names)}) written to {written}")
        return 0

    def _check_source_stays(self, written: Iterable[Path]) -> None:
        """Insist that nothing is replaced beside what is read: a calibration may be of several files."""
        folder = self.source if self.source.is_dir() else self.source.parent
        beside = [path for path in folder.iterdir() if path.exists()]
        for file in (path for path in written if path.exists()):
            if any(file.samefile(path) for path in beside):
                where = f"lies {'in' if folder == self.source else 'beside'} {self.source}, which"
                where = "" if file.samefile(self.source) else f"{where} "
                raise ValueError(f"{file} would be replaced, and {where}is read; give another OUT")


@dataclass(frozen=True)
class Refine:
    """Correct the cameras' places and directions from the hands that they saw.

    Joints of all frames and cameras are adjusted together, bones keeping their length. The scale and the
    world stay those in which most cameras stand where they stood. A third of the frames is held out, and
    nothing is written unless these fit better.
    """

    rig: PositionalRig
    """Calibration to start from."""
    keypoints: File
    """2D key points of hands (npz), of many frames."""
    out: File
    """rig.json to write."""
    offsets: Flag = False
    """Find the cameras' offsets in time too."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> int:
        """Write the rig and print what changed."""
        from poem_jax.calibration.rig_json import write_rig
        from poem_jax.capture.calibration_report import read_rig_and_hands
        from poem_jax.capture.rig_refinement import MIN_GAIN, refine_rig
        from poem_jax.io.writable import check_file_is_writable, check_inputs_stay

        check_file_is_writable(self.out)
        check_inputs_stay([self.out], [self.rig, self.keypoints])
        rig, hands, _, time_s = read_rig_and_hands(self.rig, self.keypoints, None)
        refined = refine_rig(rig, hands, time_s, offsets=self.offsets)
        for view, name in enumerate(rig.names):
            late = f", {refined.frames_late[view]:+.2f} frames late" if self.offsets else ""
            print(
                f"{name}: turned {math.degrees(refined.turned_rad[view]):.2f} degrees, moved "
                f"{1000 * refined.moved_m[view]:.1f} mm{late}; off the others' epipolar lines "
                f"{_change(refined.used_px[:, view])} px, held out {_change(refined.held_out_px[:, view])} px"
            )
        print(f"all cameras, held out: {_change(refined.held_out_mean_px)} px (mean)")
        if not refined.helps:
            raise ValueError(
                f"the refined rig is not written: frames that were held out fit no better by it "
                f"({_change(refined.held_out_mean_px)} px, expected {100 * MIN_GAIN:.0f} % less); keep "
                f"{self.rig}"
            )
        write_rig(self.out, refined.rig)
        print(f"written to {self.out}")
        return 0


def _change(before_after: Iterable[float]) -> str:
    before, after = before_after
    return f"{before:.2f} -> {after:.2f}"


@dataclass(frozen=True)
class Calibration:
    """Check, convert and refine calibrations of cameras."""

    action: Annotated[
        Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Convert, tyro.conf.subcommand("convert")]
        | Annotated[Refine, tyro.conf.subcommand("refine")],
        tyro.conf.arg(name=""),
    ]

    @property
    def debug(self) -> bool:
        """Whether the full traceback of an error is shown."""
        return self.action.debug

    def run(self) -> int:
        """Do what was asked, and return the exit code."""
        return self.action.run()
