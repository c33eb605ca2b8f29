"""`poem demo`."""

import time
from dataclasses import dataclass
from pathlib import Path

from poem_jax.cli.messages import print_files, say, tells_what_is_left
from poem_jax.cli.options import Flag, Folder, OptionalFolder


@dataclass(frozen=True)
class Demo:
    """Reconstruct the bundled 4-camera capture and compare it with its ground truth."""

    out: Folder = Path("out/demo")
    """Folder for the results."""
    checkpoint: OptionalFolder = None
    """Model folder that poem_jax.save wrote; without it the shipped weights."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Write the results, print them and the error in millimetres."""
        from poem_jax.capture.demo import demo_folder, mpvpe_mm
        from poem_jax.capture.pipeline import reconstruct
        from poem_jax.capture.take import read_take
        from poem_jax.io.writable import check_folder_is_writable

        start = time.perf_counter()
        check_folder_is_writable(self.out)
        say("reconstructing the bundled capture; the first run on a machine compiles the model, once")
        with tells_what_is_left(self.out):
            written = reconstruct(read_take(demo_folder()), self.out, checkpoint=self.checkpoint)
        print_files(written, self.out)
        print(f"\nMPVPE {mpvpe_mm(written.arrays):.1f} mm against the ground truth")
        print(f"done in {time.perf_counter() - start:.1f} s")
