"""Make README's picture from a finished demo: `python tools/make_picture.py out/demo docs/demo.png`.

Top row: the four images of the bundled capture. Bottom row: the overlays that `make demo` wrote.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from poem_jax.capture.demo import demo_folder

SIDE = 256
"""Pixels of one tile."""


def row(files: list[Path]) -> np.ndarray:
    """Read pictures and put them side by side."""
    return np.hstack(
        [cv2.resize(cv2.imread(str(file)), (SIDE, SIDE), interpolation=cv2.INTER_AREA) for file in files]
    )


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("demo", type=Path, help="folder that `make demo` wrote")
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args()
    images = sorted(demo_folder().glob("*.jpg"))
    overlays = [next(arguments.demo.rglob(f"overlay_{image.stem}.png")) for image in images]
    cv2.imwrite(str(arguments.picture), np.vstack([row(images), row(overlays)]))


if __name__ == "__main__":
    main()
