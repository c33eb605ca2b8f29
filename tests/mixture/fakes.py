"""Parts of a mixture that cost nothing to draw, and tell what was drawn. Worker processes import them."""

import os
import signal
import time
from dataclasses import dataclass

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.frames import CorruptSampleError
from poem_jax.geometry.cameras import Cameras
from poem_jax.mixture.samples import LeftOut
from poem_jax.mixture.schedule import frame_at

HW = (16, 16)


@dataclass
class FakeSamples:
    """A part whose samples say who they are: `joints_world` holds part, frame and a random number."""

    name: str
    length: int
    bad: frozenset[int] = frozenset()
    """Corrupt frames."""
    deadly: frozenset[int] = frozenset()
    """Frames that kill the process that reads them."""
    wrong: frozenset[int] = frozenset()
    """Frames that a mistake in a program, not in data, does not survive."""
    seconds: float = 0.0
    faults: tuple[str, ...] = ()

    def frame(self, seed: int, part: int, number: int, attempt: int) -> int:
        return frame_at(seed, part, number, self.length, attempt)

    def sample(self, index: int, most_views: int, rng: np.random.Generator) -> MultiViewBatch:
        time.sleep(self.seconds)
        if index in self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        if index in self.wrong:
            raise ZeroDivisionError(f"frame {index}")
        if index in self.bad:
            raise CorruptSampleError(f"/data/{self.name}.tar", f"frame{index}", "its label is torn")
        views = int(rng.integers(1, most_views, endpoint=True))
        joints = np.zeros((21, 3), np.float32)
        joints[0] = self.length, index, rng.random()
        return MultiViewBatch(
            views=rng.integers(0, 255, (views, *HW, 3)).astype(np.uint8),
            cameras=Cameras(np.ones((views, 3, 3), np.float32), np.ones((views, 4, 4), np.float32)),
            joints_world=joints,
            vertices_world=np.zeros((778, 3), np.float32),
            keypoints_px=np.zeros((views, 21, 2), np.float32),
        )

    def key(self, index: int) -> str:
        return f"frame{index}"

    def fingerprint(self) -> dict[str, str]:
        return {f"{self.name}.tar": str(self.length)}

    def left_out(self) -> LeftOut:
        return LeftOut(self.length, len(self.faults), self.faults)
