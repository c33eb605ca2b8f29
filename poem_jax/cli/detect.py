"""`poem detect`, and the search for hands before `reconstruct` and `fit`."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from poem_jax.cli.messages import say, tells_what_is_left
from poem_jax.cli.options import File, Flag, MomentOptions, Moments, OptionalFile, PositionalFolder

FOUND_FILE = "keypoints.npz"
"""What `reconstruct` and `fit` call the key points that they find."""
SEARCH_SUFFIX = ".search"
"""Of the file beside the key points that keeps what a search has found so far."""


@dataclass(frozen=True)
class Detect:
    """Find the hands in the videos or images of a capture and write their 2D key points."""

    folder: PositionalFolder
    """The capture, as for `reconstruct`."""
    out: File
    """The key-point file (npz) to write, for `fit` or for `reconstruct --boxes`."""
    rig: OptionalFile = None
    """Calibration of any format that is read; without it the one in DIR or DIR/calibration."""
    max_hands: int = 2
    """Hands in the take, of one person or of several."""
    video: Flag = False
    """The frames follow each other as those of a video: look where the hands were in the frame before. Videos
    of 4 frames/s and more are always searched so."""
    moments: MomentOptions = Moments()
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the file and print what was found."""
        from poem_jax.io.writable import check_file_is_writable

        check_file_is_writable(self.out)
        find_keypoints(self.folder, self.out, self.rig, self.max_hands, self.video, self.moments)
        print(f"written to {self.out}")


def where_hands_are(
    folder: Path, out: Path, rig: Path | None, max_hands: int, video: bool, moments: Moments
) -> Path:
    """Return the capture's own file of boxes or key points; else find these, and write them to `out`."""
    from poem_jax.capture.take import boxes_beside

    if max_hands < 1:
        raise ValueError(f"--max-hands must be 1 or more; got {max_hands}")
    if (given := boxes_beside(folder)) is not None:
        say(f"hands are where {given} says")
        return given
    found = out / FOUND_FILE
    find_keypoints(folder, found, rig, max_hands, video, moments)
    return found


def find_keypoints(
    folder: Path,
    out: Path,
    rig_file: Path | None,
    max_hands: int,
    video: bool,
    moments: Moments,
    by_side: bool = False,
) -> None:
    """Write the key points of a capture to the file `out`, and print what was found; options as in `Detect`.

    What was found in each image of a take stays beside it, so that nothing is searched twice: not after an
    interruption, and not for a better calibration.
    """
    import numpy as np

    from poem_jax.capture.boxes_file import write_boxes
    from poem_jax.capture.detect import describe_search, detect_hands
    from poem_jax.capture.detections import SearchFile
    from poem_jax.capture.moments import find_moments
    from poem_jax.capture.take import found_at
    from poem_jax.data.capture_folder import RIG_FILES, find_rig, hand_names
    from poem_jax.io.writable import check_inputs_stay

    if max_hands < 1:
        raise ValueError(f"--max-hands must be 1 or more; got {max_hands}")
    if not folder.is_dir():
        raise FileNotFoundError(f"no capture folder at {folder}")
    timing = moments.timing()
    rig = find_rig(folder, rig_file)
    take = find_moments(folder, rig, timing)
    video = video or take.follow_closely
    # Part of a search does not replace a whole one.
    part = out.with_name(f"{out.stem}.part{out.suffix}")
    kept = out.with_name(f"{out.stem}{SEARCH_SUFFIX}")
    check_inputs_stay([out, part, kept], [rig_file, *(folder / name for name in RIG_FILES), *take.files()])
    search = describe_search(take, rig, timing, max_hands=max_hands, video=video)
    file = SearchFile(kept, search) if len(take.frames) > 1 else None
    if file is not None and file.holds_another_search():
        say(f"{kept} is of other images or options: the search begins anew")
    say(f"looking for hands in {len(take.frames)} frames of {rig.num_views} cameras")
    with _tells_how_to_go_on(kept), tells_what_is_left(part):
        hands = detect_hands(
            take.frames,
            rig,
            max_hands=max_hands,
            video=video,
            by_side=by_side,
            file=file,
            when_stopped=lambda hands: write_boxes(part, found_at(hands, take)),
        )
        write_boxes(out, found_at(hands, take))
    part.unlink(missing_ok=True)
    views = np.isfinite(hands.boxes_px).all(-1).sum(2)
    for name, count in zip(hand_names(hands.hand_side), views.T, strict=True):
        print(f"{name} hand: seen by two views or more in {(count > 1).sum()} of {len(count)} frames")


@contextlib.contextmanager
def _tells_how_to_go_on(kept: Path) -> Iterator[None]:
    """When the block is stopped, say that the same command goes on."""
    try:
        yield
    except KeyboardInterrupt:
        if kept.is_file():
            say(f"the same command goes on from there: what was found in each image is in {kept}")
        raise
