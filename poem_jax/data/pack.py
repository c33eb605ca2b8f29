"""Write any source of frames into shards of the released kind, once: one file to copy instead of millions.

Images stay the bytes that they are; labels are written in the data set's own released convention
(`tar_labels.py`), so that the release's reader reads them as well. Shard s holds the samples
[s n, (s + 1) n) of the source, whoever writes it: the bytes do not depend on the number of workers. A shard
is written whole, then named, then entered in the manifest; a second run goes on where the first one ended.
"""

import glob
import hashlib
import io
import logging
import multiprocessing
import multiprocessing.connection
import os
import pickle
import re
import signal
import tarfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from poem_jax.data.frames import CorruptSampleError, EncodedImage, FrameSource, MultiViewFrame
from poem_jax.data.manifest import Manifest, ShardEntry, read_manifest, sha256_of
from poem_jax.data.sources.hand_in_views import ManoFile
from poem_jax.data.tar_labels import convention_of, label_from_frame
from poem_jax.io.atomic import whole_file

SAMPLES_PER_SHARD = 256
_PNG_START, _JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_NOT_IN_KEYS = re.compile(r"[^A-Za-z0-9_+-]+")
_MAX_KEY = 60
"""Characters of a key: names of up to 100 fit into the plain header of a tar."""

_log = logging.getLogger(__name__)


class Packed(NamedTuple):
    """What was written."""

    shards: tuple[Path, ...]
    samples: int
    skipped: tuple[tuple[int, str], ...]
    """Number of each sample that was left out, and why."""
    manifest: Path


class _Task(NamedTuple):
    """All that a worker needs."""

    source: FrameSource
    set_name: str
    mano: ManoFile | None
    samples_per_shard: int


def pack(
    source: FrameSource,
    out: str | Path,
    *,
    set_name: str,
    split: str,
    mano: str | Path | None = None,
    samples_per_shard: int = SAMPLES_PER_SHARD,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Packed:
    """Write a source into shards `SET_mv_SPLIT-NNNNNN.tar` and a manifest `SET_mv_SPLIT.manifest.json`.

    Args:
        source: Frames of the data set; with more than one worker it is pickled.
        out: Folder.
        set_name: Whose convention the labels are written in: DexYCB, HO3D, Oakink, Arctic, Interhand,
            Freihand.
        split: For the names.
        mano: The user's MANO_RIGHT.pkl, without which ARCTIC's and InterHand2.6M's poses are left out.
        samples_per_shard: Of the source.
        workers: Processes that read and write.
        progress: Called with the samples of the source that are done and their number.

    Raises:
        ValueError: `out` holds shards of another source, or of the same one before its files changed; the
            source has no sample that can be used, or some that released tars have no field for.
        ChildProcessError: A worker process died.
    """
    if min(samples_per_shard, workers) < 1:
        raise ValueError(f"shards and workers must be at least 1; got {samples_per_shard} and {workers}")
    out, stem = Path(out), f"{set_name}_mv_{split}"
    convention_of(f"{stem}-000000.tar")
    task = _Task(source, set_name, None if mano is None else ManoFile.open(mano), samples_per_shard)
    place = out / f"{stem}.manifest.json"
    manifest = Manifest(source.name, dict(source.fingerprint()), len(source), samples_per_shard)
    manifest = _go_on(manifest, place, out)
    _remove_temporaries(out, stem)
    count = -(-len(source) // samples_per_shard)
    paths = [out / f"{stem}-{shard:06d}.tar" for shard in range(count)]
    left = [shard for shard in range(count) if paths[shard].name not in manifest.shards]
    done = len(source) - sum(len(_span(task, shard)) for shard in left)
    for shard, entry in _entries(task, left, paths, workers):
        manifest = replace(manifest, shards={**manifest.shards, paths[shard].name: entry})
        manifest.write(place)
        done += len(_span(task, shard))
        for number, problem in entry.skipped:
            _log.warning("sample %d is left out: %s", number, problem)
        if progress is not None:
            progress(done, len(source))
    return _packed(manifest, out, place)


def _remove_temporaries(out: Path, stem: str) -> None:
    """Remove what an earlier run of this set and split left when it was killed in the middle of a shard."""
    temporary = re.compile(
        rf"\.{re.escape(stem)}(-\d{{6}}\.[0-9a-f]{{8}}\.tar|\.manifest\.[0-9a-f]{{8}}\.json)"
    )
    for path in out.glob(f".{glob.escape(stem)}*"):
        if temporary.fullmatch(path.name):
            _log.info("removing %s, which was never finished", path)
            path.unlink()


def _packed(manifest: Manifest, out: Path, place: Path) -> Packed:
    entries = [manifest.shards[name] for name in sorted(manifest.shards)]
    skipped = tuple(problem for entry in entries for problem in entry.skipped)
    samples = sum(entry.samples for entry in entries)
    if not samples:
        raise ValueError(f"no sample of {manifest.source} can be used: {skipped[:1] or 'it has none'}")
    shards = tuple(out / name for name in sorted(manifest.shards) if manifest.shards[name].samples)
    return Packed(shards, samples, skipped, place)


def _go_on(manifest: Manifest, place: Path, out: Path) -> Manifest:
    """Return the manifest with the shards that an earlier run finished."""
    if not place.is_file():
        return manifest
    earlier = read_manifest(place)
    if (difference := earlier.difference(manifest)) is not None:
        raise ValueError(
            f"{place} was written from another source: {difference}. Give another folder, or remove it and "
            "its shards"
        )
    kept = {name: entry for name, entry in earlier.shards.items() if _is_there(out / name, entry)}
    return replace(manifest, shards=kept)


def _is_there(path: Path, entry: ShardEntry) -> bool:
    if not entry.samples:
        return True
    if not path.is_file() or path.stat().st_size != entry.bytes:
        return False
    return sha256_of(path) == entry.sha256


def _span(task: _Task, shard: int) -> range:
    first = shard * task.samples_per_shard
    return range(first, min(first + task.samples_per_shard, len(task.source)))


def _entries(
    task: _Task, shards: Sequence[int], paths: Sequence[Path], workers: int
) -> Iterator[tuple[int, ShardEntry]]:
    """Write shards and yield their entries as they are done."""
    if workers == 1 or len(shards) < 2:
        yield from ((shard, write_shard(task, shard, paths[shard])) for shard in shards)
        return
    pool = ProcessPoolExecutor(
        min(workers, len(shards)), multiprocessing.get_context("spawn"), _start_worker, (task,)
    )
    try:
        jobs = {pool.submit(_write_in_worker, shard, paths[shard]): shard for shard in shards}
        for job in as_completed(jobs):
            yield jobs[job], job.result()
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "a worker process died while it packed: was it killed for its memory? Use fewer --workers; what "
            "is done so far stays, and the same command goes on"
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_task: _Task | None = None
"""Of this process, if it is a worker: sent once, not with every shard."""


def _start_worker(task: _Task) -> None:
    global _task
    _task = task
    # Ctrl-C reaches the whole group; the parent decides what ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when its parent is gone: a parent that was killed cannot say so."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)


def _write_in_worker(shard: int, path: Path) -> ShardEntry:
    assert _task is not None
    return write_shard(_task, shard, path)


def write_shard(task: _Task, shard: int, path: Path) -> ShardEntry:
    """Write one shard, whole or not at all; none where no sample can be used."""
    keys: list[str] = []
    skipped: list[tuple[int, str]] = []
    with (
        whole_file(path) as temporary,
        tarfile.open(temporary, "w", format=tarfile.PAX_FORMAT) as archive,
    ):
        for number in _span(task, shard):
            try:
                frame = task.source[number]
                files = list(_files(frame, number, task))
            except CorruptSampleError as error:
                skipped.append((number, str(error)))
                continue
            keys.append(tar_key(number, frame.key))
            for suffix, data in files:
                _add(archive, f"{keys[-1]}.{suffix}", data)
    digest = hashlib.sha256("".join(f"{key}\n" for key in keys).encode()).hexdigest()
    if not keys:
        path.unlink()
        return ShardEntry("", 0, 0, digest, tuple(skipped))
    return ShardEntry(sha256_of(path), path.stat().st_size, len(keys), digest, tuple(skipped))


def tar_key(number: int, key: str) -> str:
    """Return the name of a sample in a tar: its number, and what of its key may stand there (no dots)."""
    return f"{number:07d}_{_NOT_IN_KEYS.sub('_', key)[-_MAX_KEY:]}"


def _files(frame: MultiViewFrame, number: int, task: _Task) -> Iterator[tuple[str, bytes]]:
    label = label_from_frame(frame, convention_of(f"{task.set_name}_"), index=number, mano=task.mano)
    for view, image in enumerate(frame.images):
        yield f"image_{view}.{_ending(image, frame.key)}", image.data
    yield "label.pyd", pickled(label)


def pickled(label: dict[str, Any]) -> bytes:
    """Return a pickle that any NumPy reads: 2 calls its core `numpy._core`, which 1 does not have.

    In protocol 3 the names of globals are lines of text.
    """
    data = pickle.dumps(label, protocol=3)
    return data.replace(b"cnumpy._core.multiarray\n_reconstruct\n", b"cnumpy.core.multiarray\n_reconstruct\n")


def _ending(image: EncodedImage, key: str) -> str:
    if image.data.startswith(_PNG_START):
        return "png"
    if image.data.startswith(_JPEG_START):
        return "jpg"
    raise CorruptSampleError(image.name, key, "the image begins neither as JPEG nor as PNG")


def _add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    entry = tarfile.TarInfo(name)
    entry.size = len(data)
    archive.addfile(entry, io.BytesIO(data))
