"""Captures on this machine: `python benchmarks/capture.py [--only ROW]`.

    smoothing   how much hands tremble, and how late they are, before they are smoothed and after

One function a row; each prints its lines.
"""

import argparse

from capture_smoothing import smoothing

from poem_jax.io.compilation_cache import use_compilation_cache

ROWS = {"smoothing": smoothing}


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=ROWS, help="one row")
    only = parser.parse_args().only
    use_compilation_cache()
    for name, row in ROWS.items():
        if only in (None, name):
            row()


if __name__ == "__main__":
    main()
