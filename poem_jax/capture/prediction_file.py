"""`prediction.npz`, which grows with the take on disk and not in memory, and can be read at any time."""

import contextlib
import shutil
import tempfile
import time
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.take import Take
from poem_jax.hand.topology import NUM_JOINTS, NUM_SHAPES, NUM_SKELETON_JOINTS, NUM_VERTICES
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float

FLUSH_SECONDS = 5.0
"""The file on disk is at most so much older than the results, as long as writing it is quick."""
_MAX_SHARE = 0.05
"""Of the time that may go into writing the file again and again."""
_SHAPES = {
    "joints_world": (NUM_JOINTS, 3),
    "vertices_world": (NUM_VERTICES, 3),
    "root_world": (3,),
    "pose": (NUM_SKELETON_JOINTS, 3),
    "shape": (NUM_SHAPES,),
    "translation": (3,),
    "joint_sigma_m": (NUM_JOINTS,),
}
_POINTS = ("joints_world", "vertices_world", "root_world", "translation")
_WHERE_KNOWN = ("pose", "shape", "translation", "joint_sigma_m")


class PredictionFile:
    """The arrays of `prediction.npz`; what was not reconstructed is NaN. Metres, world frame.

    `joints_world (F,H,21,3)`, `vertices_world (F,H,778,3)`, `root_world (F,H,3)`, `reprojection_px (F,H,V)`,
    `views_used (F,H,V)`, `valid (F,H)`, `frames (F,)`, `hand_side (H,)`, `cameras (V,)`, and where the engine
    gives them `pose (F,H,16,3)`, `shape (F,H,10)`, `translation (F,H,3)` and `joint_sigma_m (F,H,21)`. Points
    are float64 where the hands are far from the world's origin, else float32.

    Frames are gathered in unnamed files beside it, one per array, which vanish with the process.
    """

    def __init__(self, path: Path, take: Take, origin_world: Float[Array, "3"]) -> None:
        """Args: path: the file. take: names of hands and cameras. origin_world: is added to all points."""
        self.path = path
        self._constant = {"hand_side": np.array(take.hand_sides), "cameras": np.array(take.rig.names)}
        self._origin = origin_world
        hands, views = len(take.hand_sides), take.rig.num_views
        points = np.float64 if origin_world.any() else np.float32
        self._kinds = {
            name: ((hands, *shape), np.dtype(points if name in _POINTS else np.float32))
            for name, shape in _SHAPES.items()
        }
        self._kinds["reprojection_px"] = (hands, views), np.dtype(np.float32)
        self._kinds["views_used"] = (hands, views), np.dtype(bool)
        self._kinds["valid"] = (hands,), np.dtype(bool)
        self._files = contextlib.ExitStack()
        self._grown: dict[str, IO[bytes]] = {}
        self._known: set[str] = set()
        self._names: list[str] = []
        self._found = False
        self._due = 0.0

    def add(self, frame: Frame) -> None:
        """Append a frame, and renew the file if it is old."""
        self._names.append(frame.name)
        for name, (shape, dtype) in self._kinds.items():
            values = np.full(shape, False if dtype.kind == "b" else np.nan, dtype)
            for index, hand in enumerate(frame.hands):
                value = self._value(name, hand)
                if value is not None:
                    values[index] = value
                    self._known.add(name)
            self._file(name).write(values.tobytes())
        self._found |= any(hand.reason is None for hand in frame.hands)
        if self._found and time.monotonic() >= self._due:
            self.write()

    def write(self) -> Path:
        """Write what there is so far; the file appears whole or not at all."""
        start = time.monotonic()
        with whole_file(self.path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for name in self._kinds:
                if name in self._known or name not in _WHERE_KNOWN:
                    self._copy(name, archive)
            for name, array in {"frames": np.array(self._names), **self._constant}.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, array)
        now = time.monotonic()
        self._due = now + max(FLUSH_SECONDS, (now - start) / _MAX_SHARE)
        return self.path

    def close(self) -> None:
        """Let the gathered frames go; the file stays."""
        self._files.close()

    def _value(self, name: str, hand: HandResult) -> Any:
        if name == "valid":
            return hand.reason is None
        if name == "views_used":
            return hand.view_mask
        value = getattr(hand, name)
        return value if value is None or name not in _POINTS else value + self._origin

    def _file(self, name: str) -> IO[bytes]:
        if name not in self._grown:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            unnamed = tempfile.TemporaryFile(dir=self.path.parent)  # noqa: SIM115
            self._grown[name] = self._files.enter_context(unnamed)
        return self._grown[name]

    def _copy(self, name: str, archive: zipfile.ZipFile) -> None:
        file = self._file(name)
        file.seek(0)
        shape, dtype = self._kinds[name]
        header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False}
        header["shape"] = (len(self._names), *shape)
        with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(member, header)
            shutil.copyfileobj(file, member)
