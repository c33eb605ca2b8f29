"""`poem demo`."""

import json
import time
from dataclasses import dataclass
from pathlib import Path

from poem_jax.cli.messages import say
from poem_jax.cli.options import Flag, Folder


@dataclass(frozen=True)
class Demo:
    """Reconstruct both hands of the four videos that ship, and compare them with the truth."""

    out: Folder = Path("out/demo")
    """Folder for the results."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Do what `poem reconstruct` does with these videos; print the error in millimetres."""
        import numpy as np

        from poem_jax.capture.demo import demo_folder, demo_score
        from poem_jax.cli.reconstruct import Reconstruct
        from poem_jax.io.writable import check_folder_is_writable

        start = time.perf_counter()
        check_folder_is_writable(self.out)
        command = Reconstruct(demo_folder(), self.out)
        say(f"poem reconstruct {command.folder} --out {self.out}")
        command.run()
        names = json.loads((self.out / "report.json").read_text(encoding="utf-8"))["hands"]
        with np.load(self.out / "prediction.npz") as arrays:
            score = demo_score(arrays, names)
        print(
            f"\nMPVPE {score.mpvpe_mm:.1f} mm, MPJPE {score.mpjpe_mm:.1f} mm against the truth, "
            f"over {score.found} of {score.of} hands"
        )
        print(f"look at {self.out / 'index.html'}")
        print(f"done in {time.perf_counter() - start:.0f} s")
