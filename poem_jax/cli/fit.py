"""`poem fit`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from poem_jax.cli.detect import where_hands_are
from poem_jax.cli.messages import print_files, print_summary, say, tells_what_is_left
from poem_jax.cli.options import (
    Bridge,
    Detector,
    Flag,
    Folder,
    Formats,
    MomentOptions,
    Moments,
    OptionalFile,
    OptionalFolder,
)

if TYPE_CHECKING:
    from poem_jax.capture.smoothing import Smoothing
    from poem_jax.hand.model import HandModel


@dataclass(frozen=True)
class Fit:
    """Fit hands to 2D key points from several calibrated cameras: no images are needed.

    Given a capture's folder, its boxes.npz or keypoints.npz is taken, or the key points are found in its
    images first, as by `poem detect`.
    Writes what `reconstruct` writes, with pose, shape and place of the hand model, and the uncertainty of
    every joint; see docs/fitting.md.
    """

    keypoints: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="KEYPOINTS|DIR")]
    """Key points (npz), or the folder of a capture; see docs/captures.md."""
    out: Folder
    """Folder for the results; files of the same name are replaced."""
    rig: OptionalFile = None
    """Calibration of any format that is read; without it the one in the folder of --images or of KEYPOINTS,
    or in its calibration/."""
    max_hands: int = 2
    """Hands that are looked for in a capture's images."""
    video: Flag = False
    """As for `poem detect`."""
    moments: MomentOptions = Moments()
    images: OptionalFolder = None
    """Capture folder with the images to draw on, where KEYPOINTS is a file."""
    mano: OptionalFile = None
    """MANO_RIGHT.pkl or MANO_LEFT.pkl, or an npz with MANO's names; without it the shipped hand."""
    smooth: Flag = False
    """Hold the frames of a take together: hands tremble less, and are bridged where unseen for a moment."""
    causal: Flag = False
    """Smooth by what came before alone, as a live picture has to."""
    bridge: Bridge = None
    """With --smooth or --causal: for how long a hand that is not seen is bridged, seconds (0.2; 0: never)."""
    detector: Detector = "file"
    """What found the key points, whose habits the fit allows for; file: what KEYPOINTS names, if anything;
    none: nothing known, they are the joints and finger tips."""
    meshes: Flag = False
    """Write the meshes of every frame of a take too, not only its animation."""
    formats: Formats = "glb"
    """As for `poem reconstruct`."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the results and print where they are."""
        from poem_jax.capture.outputs.formats import formats_of
        from poem_jax.capture.pipeline import fit
        from poem_jax.capture.take import read_keypoint_take
        from poem_jax.capture.write import take_files
        from poem_jax.io.writable import check_folder_is_writable, check_inputs_stay

        formats = formats_of(self.formats)
        smoothing = smoothing_of(self.smooth, self.causal, self.bridge)
        check_folder_is_writable(self.out)
        check_inputs_stay(take_files(self.out), (self.keypoints, self.rig, self.mano))
        hand = hand_from(self.mano)
        keypoints, images = self.keypoints, self.images
        if self.moments.are_part and not keypoints.is_dir():
            raise ValueError(f"--start, --end and --every are for a capture's folder; {keypoints} is a file")
        if keypoints.is_dir():
            if images is not None:
                raise ValueError(
                    f"--images goes with a file of key points; {keypoints} is a folder of images"
                )
            images = keypoints
            keypoints = where_hands_are(images, self.out, self.rig, self.max_hands, self.video, self.moments)
        take = read_keypoint_take(keypoints, self.rig, images, self.moments.timing())
        say(f"{take.num_frames} frames; the first run on a machine compiles the fit, once")
        with tells_what_is_left(self.out):
            written = fit(
                take,
                self.out,
                hand=hand,
                smoothing=smoothing,
                detector=named_detector(self.detector),
                meshes=self.meshes or None,
                formats=formats,
            )
        print_files(written, self.out)
        print_summary(written.report)


def named_detector(option: Detector) -> str | None:
    """Return the name that overrides the file's; None = as the file says."""
    return None if option == "file" else option


def smoothing_of(smooth: bool, causal: bool, bridge: float | None) -> "Smoothing":
    """Return what the options --smooth, --causal and --bridge ask for."""
    from poem_jax.capture.smoothing import Smoothing

    if bridge is not None and not (smooth or causal):
        raise ValueError("--bridge goes with --smooth or --causal; add one of them")
    if smooth and causal:
        raise ValueError("--smooth looks ahead and --causal does not; give one of them")
    mode = "causal" if causal else "offline" if smooth else "off"
    return Smoothing(mode) if bridge is None else Smoothing(mode, bridge)


def hand_from(path: Path | None) -> "HandModel | None":
    """Read the user's hand, if one is given."""
    from poem_jax.hand.mano_file import load

    return None if path is None else load(path)
