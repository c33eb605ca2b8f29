"""YAML of untrusted files: plain values, within bounds, and every fault by its file's name."""

import pytest

from poem_jax.io.yaml_file import read_yaml


def test_plain_values_are_read(tmp_path):
    path = tmp_path / "meta.yml"
    path.write_text("num_frames: 72\nmano_sides: [right]\nextrinsics: '20200702_151821'\n")
    expected = {"num_frames": 72, "mano_sides": ["right"], "extrinsics": "20200702_151821"}
    assert read_yaml(path) == expected


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: &x [1, 1]\nb: [*x, *x]\n", "aliases"),
        ("[" * 2000, "nests too deeply|cannot be read"),
        ("- " * 2000 + "1", "nests too deeply|cannot be read"),
        ("a: [1, 2\n", "cannot be read as YAML"),
        ("!!python/object/apply:os.system ['true']", "cannot be read as YAML"),
        ("a: \x00", "cannot be read as YAML"),
        ("x" * (2**20 + 1), "bytes, of at most"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, problem):
    path = tmp_path / "meta.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"meta\.yml.*({problem})"):
        read_yaml(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no calibration at .*extrinsics\.yml"):
        read_yaml(tmp_path / "extrinsics.yml", what="calibration")
