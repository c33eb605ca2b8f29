"""Every parser of files that come from elsewhere, on thousands of damaged ones: only own errors come out.

A parser may read a damaged file, when the damage makes another good one, or raise `ValueError` or
`FileNotFoundError`. Anything else is a fault of the parser, as is memory out of proportion to the file. Each
input is made from the parser's name and a number, which a failure prints: see `damaged`.
"""

import hashlib
import io
import json
import logging
import pickle
import struct
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from scipy import sparse

from poem_jax.calibration.rig_json import read_rig
from poem_jax.capture.boxes_file import read_boxes
from poem_jax.hand import mano_file
from poem_jax.hand.template import default_hand
from poem_jax.io.checksums import check_checksums
from poem_jax.io.images import read_image
from poem_jax.io.json_file import read_json
from poem_jax.io.npz_file import read_npy
from poem_jax.io.torch_file import load_state_dict
from poem_jax.models.presets import preset
from poem_jax.weights.config_json import from_values, to_json
from tests.fuzz.mutations import Mutation, damage_archive, damage_bytes, damage_json, damage_png
from tests.torch_pickles import legacy_bytes, ordered, storage, tensor, zip_bytes

OWN_ERRORS = (ValueError, FileNotFoundError)
FEW, MANY = 120, 1800
"""Inputs for each parser in the default suite, and in CI; for slow ones a share of it."""
LONGEST_MESSAGE = 2000
"""Characters of an error, whatever a file holds."""
MAX_MEMORY = 2**29
"""Half a GiB more than before is allowed while damaged files of a few kilobytes are read."""


CHECKED = b"contents of a file"


class Case(NamedTuple):
    """A parser, and what it should read."""

    read: Callable[[Path], Any]
    files: Callable[[], list[bytes]]
    damage: Mutation = damage_bytes
    share: float = 1.0


def rigs() -> list[bytes]:
    camera = {"width": 1280, "height": 720, "R": np.eye(3).tolist(), "dist": [0.1, 0, 0, 0, 0]}
    K = [[900, 0, 640], [0, 900, 360], [0, 0, 1]]
    cameras = [{"name": f"cam_{i}", "K": K, "t": [i, 0, 2], **camera} for i in range(3)]
    other = [{**c, "t": [[x] for x in c["t"]], "dist": [[0.1, 0, 0, 0]], "width": 1280.0} for c in cameras]
    return [
        json.dumps({"unit": "metre", "cameras": cameras}).encode(),
        json.dumps({"unit": "mm", "cropped": True, "cameras": other}).encode(),
    ]


def boxes() -> list[bytes]:
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 100, (2, 1, 3, 21, 2))
    low = rng.uniform(0, 50, (2, 1, 3, 2))
    common = {
        "hand_side": np.array(["left"]),
        "frames": np.array(["a", "b"]),
        "cameras": np.array(list("xyz")),
    }
    return [
        npz(keypoints_px=keypoints, confidence=np.ones(keypoints.shape[:-1]), **common),
        npz(boxes_px=np.concatenate([low, low + 20], -1), **common),
    ]


def npz(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def hand() -> dict[str, Any]:
    """Fields of MANO, small where they can be: a hand of its 16 joints, each of which moves a vertex."""
    v_template = np.zeros((778, 3), np.float16)
    v_template[:16] = np.asarray(default_hand().J_regressor @ default_hand().v_template)
    return {
        "v_template": v_template,
        "shapedirs": np.zeros((778, 3, 10), np.float16),
        "posedirs": np.zeros((778, 3, 135), np.float16),
        "J_regressor": np.eye(16, 778),
        "weights": np.concatenate([np.eye(16), np.eye(1, 16).repeat(762, 0)]),
        "f": np.tile(np.arange(3, dtype=np.uint16), (1538, 1)),
        "hands_mean": np.zeros(45),
        "hands_components": np.zeros((45, 45), np.float16),
        "kintree_table": np.stack([[4294967295, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14], range(16)]),
    }


def hand_pickles() -> list[bytes]:
    forms = [sparse.csc_matrix, sparse.coo_matrix, sparse.lil_matrix, sparse.bsr_matrix]
    hands = [OrderedDict({**hand(), "J_regressor": form(hand()["J_regressor"])}) for form in forms]
    return [pickle.dumps(fields, protocol=p) for fields, p in zip(hands, (2, 0, 4, 5), strict=True)]


def torch_files(form: str) -> list[bytes]:
    weight = tensor(storage(form), (3, 4), (4, 1))
    bias = tensor(storage(form, "1", 3), (3,))
    operations = ordered({"weight": weight, "bias": bias})
    storages = {"0": np.arange(12, dtype=np.float32), "1": np.arange(3, dtype=np.float32)}
    return [(legacy_bytes if form == "legacy" else zip_bytes)(operations, storages)]


def pictures() -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (12, 20, 3), np.uint8), (0, 0), 2)


def pngs() -> list[bytes]:
    image = pictures()
    kinds = [image, image[..., 0], image.astype(np.uint16) << 4, np.dstack([image, image[..., 0]])]
    encoded = [cv2.imencode(".png", kind)[1].tobytes() for kind in kinds]
    exif = b"MM\0*" + struct.pack(">IHHHIHxx", 8, 1, 0x0112, 3, 1, 6)
    chunk = struct.pack(">I4s", len(exif), b"eXIf") + exif + struct.pack(">I", zlib.crc32(b"eXIf" + exif))
    return [*encoded, encoded[0][:33] + chunk + encoded[0][33:]]


def jpegs() -> list[bytes]:
    data = cv2.imencode(".jpg", pictures())[1].tobytes()
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIHxx", 8, 1, 0x0112, 3, 1, 6)
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    grey = cv2.imencode(".jpg", pictures()[..., 0], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    return [data, data[:2] + segment + data[2:], grey]


def arrays() -> list[bytes]:
    streams = [io.BytesIO(), io.BytesIO()]
    np.save(streams[0], np.arange(12.0).reshape(3, 4))
    np.save(streams[1], np.arange(12, dtype=">i2").reshape(4, 3).T)
    return [stream.getvalue() for stream in streams]


def configs() -> list[bytes]:
    return [to_json(preset(name)).encode() for name in ("tiny", "v2-small-release")]


def checksums() -> list[bytes]:
    digest = hashlib.sha256(CHECKED).hexdigest()
    return [json.dumps({name: {"bytes": len(CHECKED), "sha256": digest} for name in ("a", "b")}).encode()]


def read_checksums(path: Path) -> None:
    folder = path.parent / "folder"
    if not folder.is_dir():
        folder.mkdir()
        for name in ("a", "b"):
            (folder / name).write_bytes(CHECKED)
    check_checksums(path, folder)


CASES = {
    "rig": Case(read_rig, rigs, damage_json),
    "boxes": Case(read_boxes, boxes, damage_archive),
    "hand pickle": Case(mano_file.load, hand_pickles, share=0.3),
    "hand npz": Case(mano_file.load, lambda: [npz(**hand())], damage_archive, share=0.5),
    "hand pose space": Case(mano_file.load_pose_components, hand_pickles, share=0.1),
    "torch zip": Case(load_state_dict, lambda: torch_files("zip"), damage_archive),
    "torch legacy": Case(load_state_dict, lambda: torch_files("legacy")),
    "png": Case(lambda path: read_image(path, (20, 12)), pngs, damage_png),
    "png of any size": Case(read_image, pngs, damage_png),
    "jpeg": Case(lambda path: read_image(path, (20, 12)), jpegs),
    "jpeg of any size": Case(read_image, jpegs),
    "npy": Case(read_npy, arrays),
    "config": Case(lambda path: from_values(read_json(path)), configs, damage_json),
    "checksums": Case(read_checksums, checksums, damage_json),
}
SUFFIXES = {"hand pickle": ".pkl", "hand pose space": ".pkl", "hand npz": ".npz"}


def damaged(case: Case, files: list[bytes], number: int) -> bytes:
    """Return damaged input `number` of a parser, made of one of its whole `files`."""
    rng = np.random.default_rng(number)
    return case.damage(rng, files[rng.integers(len(files))])


@pytest.fixture(autouse=True)
def silence() -> Iterator[None]:
    """Thousands of warnings about thousands of files are made, and not shown."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.fixture
def peak_memory() -> Callable[[], int]:
    """The largest memory of this process since the last call, bytes; 0 where the system does not tell."""

    def measure() -> int:
        try:
            status = Path("/proc/self/status").read_text()
            Path("/proc/self/clear_refs").write_text("5")
        except OSError:
            return 0
        return next(int(line.split()[1]) << 10 for line in status.splitlines() if line.startswith("VmHWM"))

    return measure


def read_damaged(name: str, count: int, tmp_path: Path) -> None:
    case, files = CASES[name], CASES[name].files()
    path = tmp_path / f"file{SUFFIXES.get(name, '')}"
    for number in range(int(count * case.share)):
        path.write_bytes(damaged(case, files, number))
        try:
            case.read(path)
        except OWN_ERRORS as error:
            message = str(error)
        except Exception as error:
            raise AssertionError(f"{name} {number}: {type(error).__name__} came out: {error}") from error
        else:
            continue
        assert message.strip(), f"{name} {number}: an error without a message"
        assert len(message) < LONGEST_MESSAGE, f"{name} {number}: {message[:500]}"


@pytest.mark.parametrize("name", CASES)
def test_whole_files_are_read(name: str, tmp_path: Path) -> None:
    for data in CASES[name].files():
        path = tmp_path / f"file{SUFFIXES.get(name, '')}"
        path.write_bytes(data)
        CASES[name].read(path)


@pytest.mark.parametrize("name", CASES)
def test_only_own_errors_come_out(name: str, tmp_path: Path) -> None:
    read_damaged(name, FEW, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_only_own_errors_come_out_of_many(name: str, tmp_path: Path, peak_memory: Callable[[], int]) -> None:
    peak_memory()
    before = peak_memory()
    read_damaged(name, MANY, tmp_path)
    assert peak_memory() - before < MAX_MEMORY
