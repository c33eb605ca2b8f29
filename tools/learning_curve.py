"""Print a learning curve as a Markdown table: `python tools/learning_curve.py runs/tiny_synthetic`."""

import argparse
import json
from pathlib import Path

import numpy as np


def main() -> None:
    """Average the journal over windows of steps and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--every", type=int, default=300, help="steps per row")
    arguments = parser.parse_args()
    lines = (arguments.run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    entries = [entry for entry in map(json.loads, lines) if entry["group"] == "train"]
    print("| steps | key points, px | vertices, mm |\n|---|---|---|")
    for first in range(0, max(entry["step"] for entry in entries), arguments.every):
        window = [entry for entry in entries if first < entry["step"] <= first + arguments.every]
        pixels = np.mean([entry["keypoint_px"] for entry in window])
        vertices = [entry["mpvpe_mm"] for entry in window if "mpvpe_mm" in entry]
        shown = f"{np.mean(vertices):.1f}" if vertices else "not trained"
        print(f"| {first} - {first + arguments.every} | {pixels:.1f} | {shown} |")


if __name__ == "__main__":
    main()
