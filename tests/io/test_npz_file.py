"""Archives of arrays: what NumPy writes is read back, and a damaged or hostile file ends in a ValueError."""

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from poem_jax.io.npz_file import FREE_BYTES, read_npy, read_npz

RNG = np.random.default_rng(0)
ARRAYS = {
    "floats": RNG.normal(size=(3, 4)),
    "fortran": np.asfortranarray(RNG.normal(size=(3, 4)).astype(np.float32)),
    "big_endian": np.arange(5, dtype=">i4"),
    "half": np.ones(3, np.float16),
    "truth": np.array([True, False]),
    "scalar": np.array(3),
    "text": np.array(["left", "rechts ü"]),
    "bytes": np.array([b"left"]),
    "empty": np.zeros((0, 5)),
    "no_text": np.array([""]),
}


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_what_numpy_writes_is_read_back(write, tmp_path: Path):
    write(tmp_path / "a.npz", **ARRAYS)
    read = read_npz(tmp_path / "a.npz", required=["floats", "text"])
    assert list(read) == list(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype.newbyteorder("=")
        assert read[name].flags.writeable
    np.save(tmp_path / "a.npy", ARRAYS["fortran"])
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), ARRAYS["fortran"])


def header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def archive(path: Path, method: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", method) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return path


def test_claims_are_refused_before_anything_is_allocated(tmp_path: Path):
    claim = archive(tmp_path / "claim.npz", x=header((10**12,)) + bytes(80))
    negative = archive(tmp_path / "negative.npz", x=header((-1, -10)) + bytes(80))
    text = archive(tmp_path / "text.npz", x=header((1,), "<U200000000") + bytes(80))
    bomb = archive(
        tmp_path / "bomb.npz", small=header((1,)) + bytes(8), x=header((10**7,)) + bytes(8 * 10**7)
    )
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"`x`: it claims shape \(1000000000000,\) of float64, but has 80"):
        read_npz(claim)
    with pytest.raises(ValueError, match=r"`x`: it claims shape \(-1, -10\)"):
        read_npz(negative)
    with pytest.raises(ValueError, match="`x`: it claims shape"):
        read_npz(text)
    with pytest.raises(ValueError, match=r"would take 8\d+ bytes, of at most \d+ .* the largest is `x`"):
        read_npz(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_a_real_take_that_compresses_well_is_no_bomb(tmp_path: Path):
    unseen = np.full(FREE_BYTES // 8 - 100, np.nan)
    np.savez_compressed(tmp_path / "a.npz", unseen=unseen)
    assert np.isnan(read_npz(tmp_path / "a.npz")["unseen"]).all()


@pytest.mark.parametrize(
    ("array", "kind"),
    [
        (np.array([1j]), "complex numbers"),
        (np.array([{}], object), "Python objects"),
        (np.zeros(1, "i4,f8"), "records"),
        (np.array(["2020-01-01"], "M8[D]"), "dates"),
    ],
)
def test_only_plain_numbers_and_text(array, kind, tmp_path: Path):
    np.savez(tmp_path / "a.npz", x=array)
    with pytest.raises(
        ValueError, match=rf"a\.npz must be an npz .*`x`: it must hold plain numbers .*{kind}"
    ):
        read_npz(tmp_path / "a.npz")


def changed(data: bytes, position: int, new: bytes) -> bytes:
    return data[:position] + new + data[position + len(new) :]


def test_damaged_archives_end_in_a_value_error_with_its_cause(tmp_path: Path):
    np.savez_compressed(tmp_path / "whole.npz", x=RNG.normal(size=1000))
    whole = (tmp_path / "whole.npz").read_bytes()
    directory = whole.rindex(b"PK\x01\x02")
    damages = {
        "zlib.error|error: Error -3": changed(whole, 60, b"\xff" * 200),
        "BadZipFile|is not a zip": whole[:500],
        "NotImplementedError": changed(changed(whole, directory + 10, b"\x63\0"), 8, b"\x63\0"),
        "RuntimeError.*encrypted": changed(changed(whole, directory + 8, b"\1\0"), 6, b"\1\0"),
        "not a zip": b"text",
    }
    for cause, data in damages.items():
        (tmp_path / "damaged.npz").write_bytes(data)
        with pytest.raises(ValueError, match=rf"(?s)damaged\.npz must be an npz .*({cause})"):
            read_npz(tmp_path / "damaged.npz")
    stored = archive(tmp_path / "flipped.npz", zipfile.ZIP_STORED, x=header((4,)) + bytes(32))
    data = stored.read_bytes()
    stored.write_bytes(changed(data, data.index(b"PK\x01\x02") - 8, b"\1"))
    with pytest.raises(ValueError, match="Bad CRC"):
        read_npz(stored)


def test_names(tmp_path: Path):
    np.savez(tmp_path / "a.npz", x=1, y=2)
    with pytest.raises(ValueError, match=r"a\.npz must hold `z`; found `x`, `y`"):
        read_npz(tmp_path / "a.npz", required=["x", "z"])
    np.save(tmp_path / "b.npy", np.ones(3))
    with pytest.raises(ValueError, match=r"one array without a name \(\.npy\)"):
        read_npz(tmp_path / "b.npy")
    with pytest.raises(FileNotFoundError, match="no npz file"):
        read_npz(tmp_path / "none.npz")
    with zipfile.ZipFile(tmp_path / "c.npz", "w") as file:
        file.writestr("notes.txt", "hello")
    with pytest.raises(ValueError, match=r"files that are no arrays: `notes\.txt`"):
        read_npz(tmp_path / "c.npz")
    twins = archive(tmp_path / "d.npz", x1=header((1,)) + bytes(8), x2=header((1,)) + bytes(8))
    twins.write_bytes(twins.read_bytes().replace(b"x2.npy", b"x1.npy"))
    with pytest.raises(ValueError, match="arrays of different names"):
        read_npz(tmp_path / "d.npz")


def test_text_outside_unicode_is_named(tmp_path: Path):
    content = header((1,), "<U1") + struct.pack("<I", 0x110000)
    with pytest.raises(ValueError, match="characters that do not exist"):
        read_npz(archive(tmp_path / "a.npz", frames=content))
