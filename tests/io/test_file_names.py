"""Names that become files: what stays in its folder on every system passes, all else is named."""

from pathlib import Path

import pytest

from poem_jax.io.file_names import MAX_NAME_BYTES, safe_file_name, safe_file_names

GOOD = [
    "cam_0",
    "0001",
    "front left",
    "frame.12",
    "Übung",
    "カメラ",
    "a..b",
    "-x",
    "12:30:05",
    "x" * MAX_NAME_BYTES,
]
BAD = {
    "": "is empty",
    "  ": "is empty",
    ".": "begins with a dot",
    "..": "begins with a dot",
    ".ipynb_checkpoints": "begins with a dot",
    "../x": "is a path",
    "a/b": "is a path",
    "/etc/passwd": "is a path",
    "..\\x": "is a path",
    "C:": "is a path",
    "C:x": "is a path",
    "a\0b": r"control character U\+0000",
    "a\nb": r"control character U\+000A",
    "\x1b[2J": r"control character U\+001B",
    "a\u2028b": r"control character U\+2028",
    "\ud800": r"control character U\+D800",
    "cam ": "ends with a space",
    " cam": "begins or ends with a space",
    "cam.": "ends with a dot",
    "x" * (MAX_NAME_BYTES + 1): "is too long: 201 bytes",
    "é" * 101: "is too long: 202 bytes",
}


@pytest.mark.parametrize("name", GOOD)
def test_a_good_name_stays_as_it_is_and_is_a_file_with_all_that_we_add(name, tmp_path: Path):
    assert safe_file_name(name) == name
    file = tmp_path / f".overlay_{name}.0123456789.right.glb"
    file.write_text("mesh")
    assert file.parent == tmp_path


@pytest.mark.parametrize("name", BAD)
def test_a_bad_name_is_shown_with_its_cause(name):
    with pytest.raises(
        ValueError, match=f"^a frame must also serve as the name of a file.*{BAD[name]}"
    ) as caught:
        safe_file_name(name, "a frame")
    str(caught.value).encode()  # can be printed
    assert str(caught.value).isprintable()


def test_names_in_one_folder_differ():
    assert safe_file_names(["a", "A", "b"]) == ("a", "A", "b")
    with pytest.raises(ValueError, match="cameras must differ from each other; 'a' is both number 0 and 2"):
        safe_file_names(["a", "b", "a"], "cameras")
    with pytest.raises(ValueError, match="must differ"):  # one letter, and a letter with an accent
        safe_file_names(["caf\u00e9", "cafe\u0301"])
    with pytest.raises(ValueError, match=r"frames, number 1, must .* got '\.\.'"):
        safe_file_names(["a", ".."], "frames")
