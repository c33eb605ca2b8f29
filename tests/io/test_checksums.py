"""Checksums name the file that was cut, changed or lost."""

from pathlib import Path

import pytest

from poem_jax.io.checksums import check_checksums, write_checksums


@pytest.fixture
def summed(tmp_path: Path) -> tuple[Path, Path]:
    folder = tmp_path / "arrays"
    (folder / "deep").mkdir(parents=True)
    (folder / "a").write_bytes(b"first")
    (folder / "deep" / "b").write_bytes(b"second")
    write_checksums(tmp_path / "sums.json", folder)
    return tmp_path / "sums.json", folder


def test_a_whole_folder_passes(summed, caplog):
    sums, folder = summed
    (folder / ".DS_Store").write_bytes(b"a file manager's")
    check_checksums(sums, folder)
    assert caplog.messages == []


def test_a_folder_without_checksums_is_never_read_in_silence(summed, caplog):
    sums, folder = summed
    check_checksums(sums.with_name("none.json"), folder)
    assert "is read unchecked: none.json is missing" in caplog.text


def test_a_changed_folder_differs(summed):
    sums, folder = summed
    (folder / "deep" / "b").write_bytes(b"")
    with pytest.raises(ValueError, match="differ"):
        check_checksums(sums, folder)


def test_every_damaged_file_is_named(summed):
    sums, folder = summed
    (folder / "a").write_bytes(b"fir")
    (folder / "deep" / "b").write_bytes(b"sekond")
    with pytest.raises(
        ValueError, match=r"2 of 2 files .*a: expected 5 bytes, got 3; deep/b: its bytes have"
    ):
        check_checksums(sums, folder)
    (folder / "a").unlink()
    with pytest.raises(ValueError, match="a is missing"):
        check_checksums(sums, folder)


@pytest.mark.parametrize("text", ["", "[]", '{"a": 1}', '{"a": {"bytes": 5}}'])
def test_a_broken_sums_is_named(summed, text):
    sums, folder = summed
    sums.write_text(text)
    with pytest.raises(ValueError, match=r"sums.json .*Remove it"):
        check_checksums(sums, folder)
