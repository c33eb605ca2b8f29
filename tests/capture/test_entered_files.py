"""How much code one reconstruction is read in: a newcomer should find the way of an image in few files.

From the photographs to a hand that is judged: how a take is listed (`read_take`), and the kinds of files that
come out (`capture/outputs/`, one file each), are read by who asks for them.
"""

import sys
import threading
from pathlib import Path

import poem_jax
from poem_jax.capture.pipeline import reconstruct
from poem_jax.capture.take import read_take
from tests.one_hand.capture import one_hand_folder

PACKAGE = Path(poem_jax.__file__).parent
MAX_FILES = 25


def test_reconstruct_enters_few_files_of_capture_and_models(tmp_path):
    entered = set()

    def note(frame, event, _):
        if event == "call" and frame.f_code.co_name != "<module>":
            entered.add(frame.f_code.co_filename)

    take = read_take(one_hand_folder())
    sys.setprofile(note)
    threading.setprofile(note)
    try:
        reconstruct(take, tmp_path / "out", engine="poem")
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    ours = {Path(name).relative_to(PACKAGE) for name in entered if name.startswith(str(PACKAGE))}
    counted = sorted(
        str(path)
        for path in ours
        if path.parts[0] in ("capture", "models") and path.parts[:2] != ("capture", "outputs")
    )
    assert "capture/pipeline.py" in counted
    assert len(counted) <= MAX_FILES, "\n".join(counted)
