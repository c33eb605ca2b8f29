"""An npz that grows: what it holds at any time."""

import contextlib

import numpy as np
import pytest

from poem_jax.io import growing_npz
from poem_jax.io.growing_npz import GrowingNpz


@pytest.fixture
def file(tmp_path):
    with contextlib.closing(GrowingNpz(tmp_path / "deep" / "a.npz")) as file:
        yield file


def entry(index):
    return {"points": np.full((2, 3), index, np.float32), "seen": np.array(index % 2 == 0)}


def read(path):
    with np.load(path) as stored:
        return dict(stored)


def test_it_can_be_read_while_it_grows(file):
    for index in range(4):
        file.append(entry(index))
        file.write({"names": np.array(["a", "bc"])})
        arrays = read(file.path)
        assert arrays["points"].shape == (index + 1, 2, 3)
        assert arrays["points"].dtype == np.float32
        np.testing.assert_array_equal(arrays["points"][:, 0, 0], np.arange(index + 1))
        np.testing.assert_array_equal(arrays["seen"], np.arange(index + 1) % 2 == 0)
        assert arrays["names"].tolist() == ["a", "bc"]
    assert [path.name for path in file.path.parent.iterdir()] == ["a.npz"]


def test_arrays_can_be_left_out(file):
    file.append(entry(0))
    file.write({}, without={"seen"})
    assert read(file.path).keys() == {"points"}


def test_it_is_not_written_all_the_time(file, monkeypatch):
    file.append(entry(0))
    assert file.is_due()
    file.write({})
    assert not file.is_due()
    monkeypatch.setattr(growing_npz, "FLUSH_SECONDS", 0.0)
    monkeypatch.setattr(growing_npz, "_MAX_SHARE", 1e9)
    file.write({})
    assert file.is_due()
