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
    OptionalFile,
    OptionalFolder,
    PositionalFolder,
)

if TYPE_CHECKING:
    from poem_jax.capture.smoothing import Smoothing
    from poem_jax.capture.write import Written
    from poem_jax.hand.model import HandModel


@dataclass(frozen=True)
class Reconstruct:
    """Reconstruct the hands of a capture: meshes, overlays, a 3D page, arrays and a report.

    DIR holds one image per camera, <camera>.jpg or .png, or frames/<frame>/<camera>.jpg for a take. Boxes or
    2D key points may say where the hands are in each view, else they are looked for; see docs/captures.md.
    """

    folder: PositionalFolder
    """The capture."""
    out: Folder
    """Folder for the results; files of the same name are replaced."""
    rig: OptionalFile = None
    """Calibration; without it rig.json or calibration/rig.json in DIR."""
    boxes: OptionalFile = None
    """Boxes or key points (npz); without it boxes.npz or keypoints.npz in DIR, or what the detector finds."""
    max_hands: int = 2
    """Hands that are looked for where neither boxes nor key points are given."""
    video: Flag = False
    """As for `poem detect`."""
    checkpoint: OptionalFolder = None
    """Model folder that poem_jax.save wrote; without it the shipped weights."""
    engine: Literal["network", "fit"] = "network"
    """fit: no network, the hand model fitted to key points (if boxes are given they must hold them)."""
    mano: OptionalFile = None
    """With --engine fit, as for `poem fit`."""
    smooth: Flag = False
    """As for `poem fit`."""
    causal: Flag = False
    """As for `poem fit`."""
    bridge: Bridge = None
    """As for `poem fit`."""
    detector: Detector = "file"
    """With --engine fit, as for `poem fit`."""
    meshes: Flag = False
    """Write the meshes of every frame of a take too, not only its animation."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the results and print where they are."""
        from poem_jax.capture.write import take_files
        from poem_jax.io.writable import check_folder_is_writable, check_inputs_stay

        if self.engine == "fit" and self.checkpoint is not None:
            raise ValueError("--checkpoint is for --engine network; a fit has no weights")
        if self.engine == "network" and self.mano is not None:
            raise ValueError("--mano is for --engine fit; the network has its own hand")
        if self.engine == "network" and self.detector != "file":
            raise ValueError("--detector is for --engine fit; the network sees the images themselves")
        smoothing = smoothing_of(self.smooth, self.causal, self.bridge)
        check_folder_is_writable(self.out)
        check_inputs_stay(take_files(self.out), (self.rig, self.boxes, self.mano))
        if self.checkpoint is not None and self.folder.is_dir():
            self._check_model_fits(self.checkpoint)
        hand = hand_from(self.mano)
        boxes = self.boxes or where_hands_are(self.folder, self.out, self.rig, self.max_hands, self.video)
        with tells_what_is_left(self.out):
            fits = self.engine == "fit"
            written = self._fit(boxes, hand, smoothing) if fits else self._reconstruct(boxes, smoothing)
        print_files(written, self.out)
        print_summary(written.report)

    def _check_model_fits(self, checkpoint: Path) -> None:
        """Refuse a model for another number of cameras before a take is searched for hands."""
        from poem_jax.capture.network import check_rig
        from poem_jax.data.capture_folder import find_rig
        from poem_jax.weights.store import read_config

        check_rig(read_config(checkpoint), find_rig(self.folder, self.rig))

    def _reconstruct(self, boxes: Path, smoothing: "Smoothing") -> "Written":
        from poem_jax.capture.pipeline import reconstruct
        from poem_jax.capture.take import read_take

        take = read_take(self.folder, self.rig, boxes)
        say(f"{take.num_frames} frames; the first run on a machine compiles the model, once")
        return reconstruct(
            take, self.out, checkpoint=self.checkpoint, smoothing=smoothing, meshes=self.meshes or None
        )

    def _fit(self, boxes: Path, hand: "HandModel | None", smoothing: "Smoothing") -> "Written":
        from poem_jax.capture.pipeline import fit
        from poem_jax.capture.take import read_take
        from poem_jax.cli.fit import named_detector

        take = read_take(self.folder, self.rig, boxes)
        say(f"{take.num_frames} frames; the first run on a machine compiles the fit, once")
        return fit(
            take,
            self.out,
            hand=hand,
            smoothing=smoothing,
            detector=named_detector(self.detector),
            meshes=self.meshes or None,
        )
