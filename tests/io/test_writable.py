"""Places for results are tried before the work, and left as they were."""

import pytest

from poem_jax.io.writable import check_file_is_writable, check_folder_is_writable, check_inputs_stay


def test_good_places_pass_and_stay_as_they_were(tmp_path):
    check_folder_is_writable(tmp_path)
    check_folder_is_writable(tmp_path / "a" / "b")
    check_file_is_writable(tmp_path / "a" / "b.npz")
    assert list(tmp_path.iterdir()) == []
    file = tmp_path / "old.npz"
    file.write_text("old")
    check_file_is_writable(file)
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_that_is_a_file_or_below_one(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(ValueError, match=r"file cannot be one: .*file is a file; give another --export"):
        check_folder_is_writable(file, "--export")
    with pytest.raises(ValueError, match=r"file/a/b cannot be one: .*file is a file; give another --out"):
        check_folder_is_writable(file / "a" / "b")


def test_a_file_that_is_a_folder_or_in_one_that_cannot_be(tmp_path):
    with pytest.raises(ValueError, match=r"it is a folder; give another --json"):
        check_file_is_writable(tmp_path, "--json")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"cannot write the file .*Not a directory"):
        check_file_is_writable(tmp_path / "file" / "r.json")


@pytest.mark.parametrize("check", [check_folder_is_writable, check_file_is_writable])
def test_names_that_no_file_system_takes(tmp_path, check):
    with pytest.raises(ValueError, match="File name too long"):
        check(tmp_path / ("x" * 300))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("check", [check_folder_is_writable, check_file_is_writable])
def test_a_file_system_that_takes_no_files(check):
    with pytest.raises(ValueError, match="give another --out"):
        check("/proc/poem_jax")


def test_files_that_are_read_are_not_replaced(tmp_path):
    out, rig = tmp_path / "out", tmp_path / "rig.json"
    rig.write_text("mine")
    check_inputs_stay([out / "report.json", tmp_path / "new.npz"], [rig, None, tmp_path / "missing"])
    out.symlink_to(tmp_path)
    with pytest.raises(ValueError, match=r"rig\.json would be replaced .* is read; give another --to"):
        check_inputs_stay([out / "rig.json"], [None, rig], "--to")
