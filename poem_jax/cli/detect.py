"""`poem detect`."""

from dataclasses import dataclass
from functools import partial

from poem_jax.cli.messages import say, tells_what_is_left
from poem_jax.cli.options import File, Flag, OptionalFile, PositionalFolder


@dataclass(frozen=True)
class Detect:
    """Find both hands in the images of a capture with MediaPipe and write their 2D key points."""

    folder: PositionalFolder
    """The capture, as for `reconstruct`."""
    out: File
    """The key-point file (npz) to write, for `fit` or for `reconstruct --boxes`."""
    rig: OptionalFile = None
    """Calibration; without it rig.json or calibration/rig.json in DIR."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the file and print what was found."""
        import numpy as np

        from poem_jax.capture.boxes_file import write_boxes
        from poem_jax.capture.detect import detect_hands
        from poem_jax.capture.folder import RIG_FILES, find_frames, find_rig
        from poem_jax.io.writable import check_file_is_writable, check_inputs_stay

        check_file_is_writable(self.out)
        rig = find_rig(self.folder, self.rig)
        frames = find_frames(self.folder, rig.names)
        images = [image for frame in frames for image in frame.images]
        check_inputs_stay([self.out], [self.rig, *(self.folder / name for name in RIG_FILES), *images])
        say(f"looking for hands in {len(frames)} frames of {rig.num_views} cameras")
        with tells_what_is_left(self.out):
            hands = detect_hands(frames, rig, when_stopped=partial(write_boxes, self.out))
            write_boxes(self.out, hands)
        views = np.isfinite(hands.boxes_px).all(-1).sum(2)
        for side, count in zip(hands.hand_side, views.T, strict=True):
            print(f"{side} hand: seen by two views or more in {(count > 1).sum()} of {len(count)} frames")
        print(f"written to {self.out}")
