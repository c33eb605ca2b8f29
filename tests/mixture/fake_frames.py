"""A data set in memory."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from poem_jax.data.frames import CorruptSampleError, EncodedImage, MultiViewFrame
from tests.data.one_frame import one_frame


@dataclass
class FakeFrames:
    """A data set of posed hands before noise, in memory."""

    name: str = "fake train"
    length: int = 5
    views: int = 3
    pose: bool = True
    stamp: str = "1"
    damaged: frozenset[int] = frozenset()
    """Frames whose first picture is torn."""
    faults: list[CorruptSampleError] = field(default_factory=list)

    @property
    def lost_samples(self) -> int:
        return 3 * len(self.faults)

    @property
    def max_views(self) -> int:
        return self.views

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> MultiViewFrame:
        frame = one_frame(seed=index, views=self.views, key=f"take/{index:06d}")
        images = [
            EncodedImage(
                _picture(index, view)[: 90 if index in self.damaged else None], f"{index}/{view}.png"
            )
            for view in range(self.views)
        ]
        frame = frame._replace(images=tuple(images))
        return frame if self.pose else frame._replace(pose_cam=None, shape=None)

    def fingerprint(self) -> dict[str, str]:
        return {"fake.tar": self.stamp}


def _picture(index: int, view: int) -> bytes:
    small = np.random.default_rng((index, view)).integers(0, 255, (6, 8, 3)).astype(np.uint8)
    return cv2.imencode(".png", cv2.resize(small, (320, 240)))[1].tobytes()
