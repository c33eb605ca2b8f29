"""Time of the hand detector an image, beside MediaPipe's own: `python benchmarks/detection.py FOLDER`.

Without FOLDER nothing is timed. FOLDER holds photographs (.jpg, .png), looked through at any depth. MediaPipe
runs in a process of its own, in the environment whose interpreter `--mediapipe PYTHON` names (it does not go
together with ours); without it our figures stand alone. Both look at RGB images that they have just decoded,
each by itself, for at most two hands, with the full models. They take turns, all images each (with turns
image by image the threads of one still wait for work while the other is timed), and the medians over the
turns are compared.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from poem_jax.detection import find_hands
from poem_jax.io.compilation_cache import use_compilation_cache
from poem_jax.io.images import read_image

_RIVAL = """
import sys, time
import cv2, mediapipe
hands = mediapipe.solutions.hands.Hands(
    static_image_mode=True, max_num_hands=2, model_complexity=1, min_detection_confidence=0.5
)
for line in sys.stdin:
    image = cv2.cvtColor(cv2.imread(line.rstrip("\\n")), cv2.COLOR_BGR2RGB)
    start = time.perf_counter()
    found = hands.process(image)
    took = time.perf_counter() - start
    print("took", took, len(found.multi_hand_landmarks or []), flush=True)
"""


class Mediapipe:
    """MediaPipe in another process."""

    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process

    def time(self, path: Path) -> float:
        """Return the seconds that an image takes."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{path.resolve()}\n")
        self._process.stdin.flush()
        for line in self._process.stdout:
            if line.startswith("took"):
                return float(line.split()[1])
        raise SystemExit("the process of MediaPipe ended")


@contextmanager
def mediapipe(python: str | None) -> Iterator[Mediapipe | None]:
    """Start MediaPipe in the environment of an interpreter; None = without it."""
    if python is None:
        yield None
        return
    with subprocess.Popen(
        [python, "-c", _RIVAL],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        yield Mediapipe(process)
        assert process.stdin is not None
        process.stdin.close()


def our_time(path: Path) -> float:
    """Return the seconds that an image takes here, once it is read."""
    image = read_image(path)
    start = time.perf_counter()
    find_hands([image])
    return time.perf_counter() - start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Time of the hand detector an image.")
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--mediapipe", metavar="PYTHON")
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    if options.folder is None:
        print("skipped: say a FOLDER of photographs")
        return
    use_compilation_cache()
    paths = sorted(p for p in options.folder.rglob("*") if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    paths = paths[:: max(1, len(paths) // options.images)][: options.images]
    if not paths:
        sys.exit(f"no images in {options.folder}")
    print(f"first call, compiled or read from the cache: {our_time(paths[0]):.1f} s")
    ours, theirs = (np.full((options.rounds, len(paths)), np.nan) for _ in range(2))
    with mediapipe(options.mediapipe) as rival:
        if rival is not None:
            rival.time(paths[0])
        for turn in range(options.rounds):
            ours[turn] = [our_time(path) for path in paths]
            if rival is not None:
                theirs[turn] = [rival.time(path) for path in paths]
    ours, theirs = np.median(ours, 0), np.median(theirs, 0)
    print(f"{len(paths)} images, median of {options.rounds} turns each")
    print(f"poem_jax   {1000 * np.median(ours):6.1f} ms an image (median), {1000 * ours.mean():6.1f} (mean)")
    if options.mediapipe is not None:
        print(f"mediapipe  {1000 * np.median(theirs):6.1f} ms, {1000 * theirs.mean():6.1f}")
        print(
            f"ratio      {np.median(ours / theirs):6.2f} (median), {ours.mean() / theirs.mean():.2f} (means)"
        )


if __name__ == "__main__":
    main()
