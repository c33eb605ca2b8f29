"""How fast are packed tars read? `python benchmarks/data.py [--seconds S] [--smoke]`.

Prints views per second from tars of 640 x 480 JPEGs (the miniature DexYCB, repeated) to augmented 256 x 256
crops, read by 1 and 2 processes, with OpenCV's decoder and, where simplejpeg is installed, with
libjpeg-turbo's, at full size and shrinking, in interleaved rounds; the memory of a worker after 1,000 and
10,000 samples; and the seconds that a new process needs to open 10 GB of shards whose index is cached. Wanted
on 2 cores: at least 500 views per second, at most 300 MB, at most 2 s.
"""

import argparse
import dataclasses
import io
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.data.augmentation import PAPER, augment
from poem_jax.data.pictures import decoder
from poem_jax.data.sources.released_tars import ReleasedTars

IMAGE_HW = (256, 256)
ROUNDS = 5
CHUNK = 4
SEED = 20261127
SHARD_SAMPLES = 64
OPENED_BYTES = 10 * 2**30
IMAGE_BYTES = 60_000
TARGET_VIEWS, TARGET_MB, TARGET_S = 500, 300, 2.0


class Way(NamedTuple):
    """How images are decoded."""

    decoder: str
    shrinks: bool

    def __str__(self) -> str:
        return f"{self.decoder}{', shrinking' if self.shrinks else ''}"


@cache
def source(folder: str) -> ReleasedTars:
    """The shards, opened once in each process."""
    return ReleasedTars(folder, split="train")


def make_samples(folder: str, way: Way, first: int, count: int, most_views: int = 8) -> int:
    """Read and augment samples; return the number of views."""
    tars, using = source(folder), decoder(way.decoder)
    recipe = dataclasses.replace(PAPER, shrinks_while_decoding=way.shrinks)
    views = 0
    for index in range(first, first + count):
        frame = tars[index % len(tars)]
        chosen = np.arange(min(most_views, len(frame.images)))
        augment(frame, chosen, recipe, IMAGE_HW, np.random.default_rng((SEED, index)), using)
        views += len(chosen)
    return views


def rate(pool: ProcessPoolExecutor, workers: int, folder: str, way: Way, chunks: int) -> float:
    """Return views per second."""
    begin = time.perf_counter()
    jobs = [pool.submit(make_samples, folder, way, i * CHUNK, CHUNK) for i in range(chunks * workers)]
    views = sum(job.result() for job in jobs)
    return views / (time.perf_counter() - begin)


def rss_mb() -> float:
    """Return the resident memory of this process."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def memory_over(folder: str, samples: int) -> tuple[float, float]:
    """Return a worker's MB after a tenth of its samples, and after all of them."""
    make_samples(folder, Way("opencv", False), 0, samples // 10, most_views=2)
    early = rss_mb()
    make_samples(folder, Way("opencv", False), samples // 10, samples - samples // 10, most_views=2)
    return early, rss_mb()


def write_repeated(folder: Path, samples: int) -> None:
    """Write the miniature DexYCB's training samples again and again, each with a key of its own."""
    from poem_jax.miniatures.released_tars import write

    with tempfile.TemporaryDirectory() as made:
        write("dexycb", Path(made))
        found = next(Path(made).rglob("DexYCB_mv_train-*.tar"))
        groups: dict[str, list[tuple[str, bytes]]] = {}
        with tarfile.open(found) as tar:
            for member in tar:
                stream = tar.extractfile(member)
                key, _, field = member.name.partition(".")
                if stream is not None:
                    groups.setdefault(key, []).append((field, stream.read()))
    contents = list(groups.values())
    for first in range(0, samples, SHARD_SAMPLES):
        path = folder / f"DexYCB_mv_train-{first // SHARD_SAMPLES:06d}.tar"
        with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
            for number in range(first, min(first + SHARD_SAMPLES, samples)):
                for field, data in contents[number % len(contents)]:
                    header = tarfile.TarInfo(f"{number:09d}.{field}")
                    header.size = len(data)
                    tar.addfile(header, io.BytesIO(data))


def write_sparse(folder: Path, total_bytes: int, shards: int = 20) -> int:
    """Write shards of 8 images a sample that hold nothing but headers; return their apparent size."""
    per_sample = 9 * 512 + 8 * (-(-IMAGE_BYTES // 512) * 512) + 512
    per_shard = max(1, total_bytes // shards // per_sample)
    for shard in range(shards):
        with (folder / f"DexYCB_mv_train-{shard:06d}.tar").open("wb") as stream:
            place = 0
            for number in range(per_shard):
                members = [("label.pyd", 100), *((f"image_{view}.jpg", IMAGE_BYTES) for view in range(8))]
                for name, size in members:
                    header = tarfile.TarInfo(f"{shard * per_shard + number:09d}.{name}")
                    header.size = size
                    stream.seek(place)
                    stream.write(header.tobuf(tarfile.USTAR_FORMAT))
                    place += 512 - (-size // 512) * 512
            stream.truncate(place + 1024)
    return sum(path.stat().st_size for path in folder.glob("*.tar"))


def opening_s(folder: Path) -> float:
    """Return the seconds in which a new process opens the shards, without its imports."""
    code = (
        "import sys, time; from poem_jax.data.sources.released_tars import ReleasedTars; "
        "start = time.perf_counter(); ReleasedTars(sys.argv[1], split='train'); "
        "print(time.perf_counter() - start)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True
    )
    return float(done.stdout)


def ways() -> list[Way]:
    """Return the decoders that are installed."""
    turbo = [Way("turbo", False), Way("turbo", True)] if find_spec("simplejpeg") else []
    return [Way("opencv", False), *turbo]


def print_rates(folder: str, seconds: float, rounds: int) -> None:
    """Print the median views per second of every decoder and number of processes."""
    context = get_context("spawn")
    for workers in (1, 2):
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            warm = {way: rate(pool, workers, folder, way, 4) for way in ways()}
            chunks = {way: max(1, round(warm[way] * seconds / (8 * CHUNK * workers))) for way in ways()}
            rates: dict[Way, list[float]] = {way: [] for way in ways()}
            for _ in range(rounds):
                for way in ways():
                    rates[way].append(rate(pool, workers, folder, way, chunks[way]))
        for way, values in rates.items():
            spread = f"{min(values):.0f} to {max(values):.0f}"
            print(f"{workers} processes, {way}: {statistics.median(values):.0f} views/s ({spread})")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0, help="per round and decoder")
    parser.add_argument("--smoke", action="store_true", help="a few seconds in all, to see that it runs")
    options = parser.parse_args()
    seconds, rounds = (0.2, 1) if options.smoke else (options.seconds, ROUNDS)
    with tempfile.TemporaryDirectory() as made:
        packed, sparse = Path(made) / "packed", Path(made) / "sparse"
        packed.mkdir()
        sparse.mkdir()
        write_repeated(packed, 8 if options.smoke else 8 * SHARD_SAMPLES)
        print(f"wanted: {TARGET_VIEWS} views/s, {TARGET_MB} MB, {TARGET_S} s")
        print_rates(str(packed), seconds, rounds)
        samples = 20 if options.smoke else 10_000
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            early, late = pool.submit(memory_over, str(packed), samples).result()
        print(f"a worker: {early:.0f} MB after {samples // 10} samples, {late:.0f} MB after {samples}")
        size = write_sparse(sparse, OPENED_BYTES // (100 if options.smoke else 1))
        first, again = opening_s(sparse), statistics.median(opening_s(sparse) for _ in range(3))
        print(f"opening {size / 2**30:.1f} GiB: {first:.2f} s, with its cached index {again:.2f} s")


if __name__ == "__main__":
    main()
