"""Small videos that tell which of their frames is which, whole and damaged."""

import struct

import cv2
import numpy as np

LEVELS = 8
"""Grey levels from one frame to the next."""
BLOCK = slice(4, 12)


def picture(index, size_wh=(64, 48), seed=0):
    """A smooth random picture that moves, with a square whose grey says the number, up to 30; BGR."""
    noise = np.random.default_rng(seed).integers(0, 255, (6, 8, 3)).astype(np.uint8)
    image = np.roll(cv2.resize(noise, size_wh, interpolation=cv2.INTER_CUBIC), index, axis=1)
    image[:16, :16] = LEVELS * index
    return image


def number_of(image):
    """The number of a frame, from its pixels."""
    return round(float(image[BLOCK, BLOCK].mean()) / LEVELS)


def write_video(path, num_frames=20, rate=10, size_wh=(64, 48), seed=0):
    kind = "MJPG" if path.suffix == ".avi" else "mp4v"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*kind), rate, size_wh)
    for index in range(num_frames):
        writer.write(picture(index, size_wh, seed))
    writer.release()
    return path


def damage(path, at=0.5, size=300):
    """Overwrite some bytes of a file, here in the pictures."""
    data = bytearray(path.read_bytes())
    start = int(at * len(data))
    data[start : start + size] = b"\xa5" * size
    path.write_bytes(data)


def cut(path, share=0.6):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


def note_turn(path):
    """Write into an mp4 that its frames are to be shown turned by 90 degrees clockwise."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


def delay_frames(path, first, steps=3):
    """Let the frames of an mp4 from `first` on come `steps` - 1 periods later, by its time stamps."""
    data = bytearray(path.read_bytes())
    at = data.index(b"stts") - 4
    _, _, _, entries, count, delta = struct.unpack_from(">I4sIIII", data, at)
    assert entries == 1
    table = [(first - 1, delta), (1, steps * delta), (count - first, delta)]
    box = struct.pack(">I4sII", 16 + 8 * len(table), b"stts", 0, len(table))
    box += b"".join(struct.pack(">II", *row) for row in table)
    data[at : at + 24] = box
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        place = data.index(name) - 4
        struct.pack_into(">I", data, place, struct.unpack_from(">I", data, place)[0] + len(box) - 24)
    path.write_bytes(data)
