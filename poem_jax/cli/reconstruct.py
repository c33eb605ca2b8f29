"""`poem reconstruct`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from poem_jax.cli.detect import where_hands_are
from poem_jax.cli.fit import hand_from, smoothing_of
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
    PositionalFolder,
)

if TYPE_CHECKING:
    from poem_jax.capture.outputs.formats import Format
    from poem_jax.capture.smoothing import Smoothing
    from poem_jax.capture.write import Written
    from poem_jax.hand.model import HandModel


@dataclass(frozen=True)
class Reconstruct:
    """Reconstruct the hands of a capture: meshes, overlays, a 3D page, arrays and a report.

    DIR holds a video for each camera, <camera>.mp4, or a folder of images, <camera>/0001.jpg; or one image,
    <camera>.jpg or .png; or frames/<frame>/<camera>.jpg. Boxes or 2D key points may say where the hands are
    in each view, else they are looked for; see docs/captures.md.
    """

    folder: PositionalFolder
    """The capture."""
    out: Folder
    """Folder for the results; files of the same name are replaced."""
    rig: OptionalFile = None
    """Calibration of any format that is read; without it the one in DIR or DIR/calibration."""
    boxes: OptionalFile = None
    """Boxes or key points (npz); without it boxes.npz or keypoints.npz in DIR, or what the detector finds."""
    max_hands: int = 2
    """Hands that are looked for where neither boxes nor key points are given."""
    video: Flag = False
    """As for `poem detect`."""
    moments: MomentOptions = Moments()
    engine: Literal["auto", "fit", "poem", "network"] = "auto"
    """poem (or network): the network, from the images. fit: no network, the hand model fitted to key points
    (if boxes are given they must hold them). auto: both are tried on a few frames, by views that neither is
    given, and the better one does the take; where only one can run, it does."""
    checkpoint: OptionalFolder = None
    """Of the network: model folder that poem_jax.save wrote; without it the shipped weights."""
    mano: OptionalFile = None
    """Of the fit, as for `poem fit`."""
    smooth: Flag = False
    """As for `poem fit`."""
    causal: Flag = False
    """As for `poem fit`."""
    bridge: Bridge = None
    """As for `poem fit`."""
    detector: Detector = "file"
    """Of the fit, as for `poem fit`."""
    meshes: Flag = False
    """Write the meshes of every frame of a take too, not only its animation."""
    formats: Formats = "glb"
    """What to write besides arrays, page, report and overlays, with commas between: glb (animation of a
    take), bvh (skeletons), csv (joints and angles), trc (markers), mano (parameters), capture (a labelled
    capture, to train on); video or png: overlays as such, else as images of a take of up to 20 frames, and as
    videos of a longer one."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the results and print where they are."""
        from poem_jax.capture.outputs.formats import formats_of
        from poem_jax.capture.write import take_files
        from poem_jax.io.writable import check_folder_is_writable, check_inputs_stay

        engine = "poem" if self.engine == "network" else self.engine
        if engine == "fit" and self.checkpoint is not None:
            raise ValueError("--checkpoint is for --engine poem; a fit has no weights")
        if engine == "poem" and self.mano is not None:
            raise ValueError("--mano is for --engine fit; the network has its own hand")
        if engine == "poem" and self.detector != "file":
            raise ValueError("--detector is for --engine fit; the network sees the images themselves")
        formats = formats_of(self.formats)
        smoothing = smoothing_of(self.smooth, self.causal, self.bridge)
        check_folder_is_writable(self.out)
        check_inputs_stay(take_files(self.out), (self.rig, self.boxes, self.mano))
        if self.checkpoint is not None and self.folder.is_dir():
            self._check_model_fits(self.checkpoint)
        hand = hand_from(self.mano)
        boxes = self.boxes or where_hands_are(
            self.folder, self.out, self.rig, self.max_hands, self.video, self.moments
        )
        with tells_what_is_left(self.out):
            written = self._reconstruct(boxes, engine, hand, smoothing, formats)
        print_files(written, self.out)
        print_summary(written.report)

    def _check_model_fits(self, checkpoint: Path) -> None:
        """Refuse a model for another number of cameras before a take is searched for hands."""
        from poem_jax.capture.network import check_rig
        from poem_jax.data.capture_folder import find_rig
        from poem_jax.weights.store import read_config

        check_rig(read_config(checkpoint), find_rig(self.folder, self.rig))

    def _reconstruct(
        self,
        boxes: Path,
        engine: Literal["auto", "fit", "poem"],
        hand: "HandModel | None",
        smoothing: "Smoothing",
        formats: "frozenset[Format]",
    ) -> "Written":
        from poem_jax.capture.pipeline import reconstruct
        from poem_jax.capture.take import read_take
        from poem_jax.cli.fit import named_detector

        take = read_take(self.folder, self.rig, boxes, self.moments.timing())
        what = "fit" if engine == "fit" else "model"
        say(f"{take.num_frames} frames; the first run on a machine compiles the {what}, once")
        return reconstruct(
            take,
            self.out,
            engine=engine,
            checkpoint=self.checkpoint,
            hand=hand,
            smoothing=smoothing,
            detector=named_detector(self.detector),
            meshes=self.meshes or None,
            formats=formats,
        )
