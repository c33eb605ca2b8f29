"""A source of a few frames in memory, which worker processes can be sent."""

from dataclasses import dataclass

from poem_jax.data.frames import CorruptSampleError, EncodedImage
from tests.data.one_frame import one_frame


@dataclass(frozen=True)
class MemorySource:
    count: int
    corrupt: tuple[int, ...] = ()
    name: str = "memory test"
    max_views: int = 3
    version: str = "1"

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        if index in self.corrupt:
            raise CorruptSampleError("memory", f"take.{index}", "planted")
        frame = one_frame(seed=index, skew=0.0, key=f"take.1/{index}")
        images = tuple(
            EncodedImage(b"\xff\xd8\xff" + bytes([index, view]) * 200, f"{view}.jpg") for view in range(3)
        )
        return frame._replace(images=images)

    def fingerprint(self):
        return {"list.txt": self.version}
