import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from poem_jax.io.npy_dict import load_npy_dict

_CONTENT = {
    "right": {"rot": np.arange(6.0).reshape(2, 3), "shape": np.ones(10, np.float32), "err": [0.5, 1]},
    "names": ["a", "b"],
}


def _header(data: bytes) -> bytes:
    """The part of an object's .npy before its pickle."""
    return data[: data.index(b"\n") + 1]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "box_grab_01.mano.npy"
    np.save(path, np.array(_CONTENT, dtype=object), allow_pickle=True)
    return path


def test_a_saved_dict_comes_back(path: Path):
    read = load_npy_dict(path)
    assert read.keys() == _CONTENT.keys()
    np.testing.assert_array_equal(read["right"]["rot"], _CONTENT["right"]["rot"])
    np.testing.assert_array_equal(read["right"]["shape"], _CONTENT["right"]["shape"])
    assert read["right"]["err"] == [0.5, 1]
    assert read["names"] == ["a", "b"]


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_every_protocol_is_read(path: Path, protocol: int):
    held = np.array(_CONTENT, dtype=object)
    path.write_bytes(_header(path.read_bytes()) + pickle.dumps(held, protocol=protocol))
    np.testing.assert_array_equal(load_npy_dict(path)["right"]["rot"], _CONTENT["right"]["rot"])


class _Runs:
    def __reduce__(self):
        return os.system, ("touch hostile",)


def test_a_hostile_dict_is_refused_and_does_not_run(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    np.save(path, np.array({"right": _Runs()}, dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"mano\.npy asks for posix\.system"):
        load_npy_dict(path)
    assert not (tmp_path / "hostile").exists()


def test_other_files_are_named(path: Path, tmp_path: Path):
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"mano\.npy must be a whole pickle"):
        load_npy_dict(path)
    np.save(path, np.arange(3.0))
    with pytest.raises(ValueError, match=r"must hold one dict; got an array of shape \(3,\)"):
        load_npy_dict(path)
    np.save(path, np.array([{}, {}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="must hold one dict"):
        load_npy_dict(path)
    path.write_bytes(_header(whole) + pickle.dumps({"a": 1}))
    with pytest.raises(ValueError, match="must hold one dict; got a dict"):
        load_npy_dict(path)
    path.write_bytes(b"no numbers at all")
    with pytest.raises(ValueError, match=r"is no \.npy file"):
        load_npy_dict(path)
    with pytest.raises(FileNotFoundError, match="other"):
        load_npy_dict(tmp_path / "other.npy")
