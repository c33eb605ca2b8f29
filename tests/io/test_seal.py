"""A seal names the file that was cut, changed or lost."""

from pathlib import Path

import pytest

from poem_jax.io.seal import check_seal, write_seal


@pytest.fixture
def sealed(tmp_path: Path) -> tuple[Path, Path]:
    folder = tmp_path / "arrays"
    (folder / "deep").mkdir(parents=True)
    (folder / "a").write_bytes(b"first")
    (folder / "deep" / "b").write_bytes(b"second")
    write_seal(tmp_path / "seal.json", folder)
    return tmp_path / "seal.json", folder


def test_a_whole_folder_passes_and_so_does_one_without_a_seal(sealed):
    seal, folder = sealed
    check_seal(seal, folder)
    (folder / "deep" / "b").write_bytes(b"")
    check_seal(seal.with_name("none.json"), folder)
    with pytest.raises(ValueError, match="differ"):
        check_seal(seal, folder)


def test_every_damaged_file_is_named(sealed):
    seal, folder = sealed
    (folder / "a").write_bytes(b"fir")
    (folder / "deep" / "b").write_bytes(b"sekond")
    with pytest.raises(
        ValueError, match=r"2 of 2 files .*a: expected 5 bytes, got 3; deep/b: its bytes have"
    ):
        check_seal(seal, folder)
    (folder / "a").unlink()
    with pytest.raises(ValueError, match="a is missing"):
        check_seal(seal, folder)


@pytest.mark.parametrize("text", ["", "[]", '{"a": 1}', '{"a": {"bytes": 5}}'])
def test_a_broken_seal_is_named(sealed, text):
    seal, folder = sealed
    seal.write_text(text)
    with pytest.raises(ValueError, match=r"seal.json .*Remove it"):
        check_seal(seal, folder)
