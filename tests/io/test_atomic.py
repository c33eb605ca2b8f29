"""Files appear whole or not at all."""

import pytest

from poem_jax.io.atomic import whole_file


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_good_end_puts_the_file_in_place(tmp_path):
    target = tmp_path / "new" / "result.txt"
    with whole_file(target) as temporary:
        assert temporary.suffix == ".txt"
        temporary.write_text("first")
        assert not target.exists()
    with whole_file(target) as temporary:
        temporary.write_text("second")
        assert target.read_text() == "first"
    assert target.read_text() == "second"
    assert names(target.parent) == ["result.txt"]
    (tmp_path / "plain.txt").touch()
    assert target.stat().st_mode == (tmp_path / "plain.txt").stat().st_mode


def fail_half_way(target, error):
    with whole_file(target) as temporary:
        temporary.write_text("half")
        raise error


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_bad_end_leaves_what_was_there(tmp_path, error):
    target = tmp_path / "result.txt"
    for before in (None, "old"):
        if before is not None:
            target.write_text(before)
        with pytest.raises(error):
            fail_half_way(target, error)
        assert names(tmp_path) == ([] if before is None else ["result.txt"])
    assert target.read_text() == "old"
