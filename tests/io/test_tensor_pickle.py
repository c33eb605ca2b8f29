import pickle
from pathlib import Path

import numpy as np
import pytest

from poem_jax.io.tensor_pickle import load_tensors_pickle
from tests.torch_pickles import call, dict_of, legacy_bytes, name, plain, storage, tensor

_NUMBERS = np.arange(16, dtype=np.float32)


def _stored(numbers: np.ndarray = _NUMBERS, kind: str = "FloatStorage", cut: int | None = None) -> bytes:
    """The operations that `pickle.dump` writes for a tensor's storage."""
    inner = storage("legacy", key="94", numel=numbers.size, kind=name("torch", kind))
    return call(name("torch.storage", "_load_from_bytes"), plain(legacy_bytes(inner, {"94": numbers})[:cut]))


def _read(tmp_path: Path, operations: bytes):
    path = tmp_path / "info.pkl"
    path.write_bytes(b"\x80\x03" + operations + b".")
    return load_tensors_pickle(path)


def _bytes(value: bytes) -> bytes:
    return pickle.dumps(value, protocol=3)[2:-1]


def test_tensors_in_containers_become_arrays(tmp_path: Path):
    hand = dict_of({"hand_pose": tensor(_stored(), (4, 4), (4, 1)), "tsl": plain([1.0, None, "x"])})
    read = _read(tmp_path, dict_of({"hand_anno": hand, "cam_extr": tensor(_stored(), (2, 3), (1, 4), 2)}))
    np.testing.assert_array_equal(read["hand_anno"]["hand_pose"], _NUMBERS.reshape(4, 4))
    np.testing.assert_array_equal(read["cam_extr"], [[2, 6, 10], [3, 7, 11]])
    assert read["hand_anno"]["tsl"] == [1.0, None, "x"]


def test_doubles_and_numpy_arrays_are_read(tmp_path: Path):
    doubles = _NUMBERS.astype(np.float64) / 3
    read = _read(tmp_path, tensor(_stored(doubles, "DoubleStorage"), (16,)))
    np.testing.assert_array_equal(read, doubles)
    path = tmp_path / "cam_intr.pkl"
    path.write_bytes(pickle.dumps(np.eye(3)))
    np.testing.assert_array_equal(load_tensors_pickle(path), np.eye(3))


@pytest.mark.parametrize(
    ("operations", "problem"),
    [
        (call(name("posix", "system"), plain("true")), r"asks for posix\.system"),
        (call(name("torch", "load"), plain("a")), r"asks for torch\.load"),
        (tensor(_stored(), (17,)), "reaches number 17"),
        (tensor(_stored(cut=-8), (16,)), "must have 64 bytes; got 56"),
        (tensor(plain([1.0]), (1,)), "must look at a storage"),
        (tensor(_stored(), (1000, 1000), (0, 0)), "far larger"),
        (_stored(), "_Storage is no data"),
    ],
)
def test_what_is_no_tensor_is_refused_by_name(tmp_path: Path, operations: bytes, problem: str):
    with pytest.raises(ValueError, match=problem) as raised:
        _read(tmp_path, operations)
    assert "info.pkl" in str(raised.value)


def test_a_program_in_the_storage_is_refused(tmp_path: Path):
    hostile = legacy_bytes(call(name("posix", "system"), plain("true")), {"94": _NUMBERS})
    with pytest.raises(ValueError, match=r"asks for posix\.system"):
        _read(tmp_path, call(name("torch.storage", "_load_from_bytes"), _bytes(hostile)))
    with pytest.raises(FileNotFoundError, match="none"):
        load_tensors_pickle(tmp_path / "none.pkl")
