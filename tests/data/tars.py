"""Tiny tar files of samples."""

import io
import tarfile
from pathlib import Path


def write_tar(path: Path, samples, *, format=tarfile.PAX_FORMAT) -> Path:
    """Write (key, {suffix: bytes}) pairs, in their order; a key may come twice."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(path, "w", format=format) as archive:
        for key, files in samples:
            for suffix, data in files.items():
                entry = tarfile.TarInfo(f"{key}.{suffix}")
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
    return path


def plain_sample(number: int, images: int = 2):
    files = {f"image_{i}.jpg": bytes([number, i]) * (300 + 211 * i) for i in range(images)}
    return f"{number:06d}", {**files, "label.pyd": b"label" + bytes([number])}
