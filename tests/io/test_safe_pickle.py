import pickle
from collections import OrderedDict

import numpy as np
import pytest

from poem_jax.io.safe_pickle import StandIn, load_arrays_pickle, loads_arrays_pickle


class _Runs:
    """Asks the reader to call something when it is loaded."""

    def __init__(self, function, *args):
        self.call = (function, args)

    def __reduce__(self):
        return self.call


def _global_call(module: str, name: str, argument: str) -> bytes:
    """A hand-written pickle: call module.name(argument)."""
    return f"c{module}\n{name}\n(S'{argument}'\ntR.".encode()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_containers_and_arrays_survive(protocol: int):
    content = {
        "floats": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
        "ints": np.arange(3, dtype=np.uint32),
        "scalar": np.float32(1.5),
        "flags": np.array([True, False]),
        "nested": [("a", 1), {"b": None}, b"bytes", 2.5],
        "text": "flat_hand",
    }
    read = loads_arrays_pickle(pickle.dumps(content, protocol=protocol))
    assert read.keys() == content.keys()
    for name in ("floats", "fortran", "ints", "scalar", "flags"):
        np.testing.assert_array_equal(read[name], content[name])
        assert read[name].dtype == content[name].dtype
    assert read["nested"] == content["nested"]
    assert read["text"] == "flat_hand"


@pytest.mark.parametrize("core", ["numpy.core", "numpy._core"])
def test_old_and_new_names_of_numpy_are_read(core: str):
    data = pickle.dumps(np.arange(4.0), protocol=2)
    other = data.replace(b"cnumpy._core.multiarray\n", f"c{core}.multiarray\n".encode())
    np.testing.assert_array_equal(loads_arrays_pickle(other), np.arange(4.0))


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "system"),
        ("posix", "system"),
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("__builtin__", "apply"),
        ("subprocess", "Popen"),
        ("numpy", "load"),
        ("numpy.core.multiarray", "fromfile"),
        ("numpy.testing._private.utils", "runstring"),
        ("collections", "defaultdict"),
        ("torch.storage", "_load_from_bytes"),
    ],
)
def test_other_globals_are_refused_by_name(module: str, name: str):
    with pytest.raises(ValueError, match=rf"asks for {module}\.{name}, which .* is refused"):
        loads_arrays_pickle(_global_call(module, name, "touch /tmp/hostile"))


def test_nothing_runs(tmp_path):
    trace = tmp_path / "ran"
    for function, args in ((exec, (f"open({str(trace)!r}, 'w')",)), (open, (str(trace), "w"))):
        with pytest.raises(ValueError, match="is refused"):
            loads_arrays_pickle(pickle.dumps(_Runs(function, *args)))
    assert not trace.exists()


def test_refused_modules_are_not_imported():
    import sys

    with pytest.raises(ValueError, match="antigravity"):
        loads_arrays_pickle(_global_call("antigravity", "geohash", ""))
    assert "antigravity" not in sys.modules


def test_allowed_names_can_be_neither_called_freely_nor_changed():
    called = b"cnumpy\nndarray\n(K\x02tR."
    with pytest.raises(ValueError, match="may not be called"):
        loads_arrays_pickle(called)
    changed = b"cnumpy\nndarray\n}S'__call__'\nK\x01sb."
    with pytest.raises(ValueError, match="may not be changed"):
        loads_arrays_pickle(changed)
    encoded = b"c_codecs\nencode\n(S'abc'\nS'zlib'\ntR."
    with pytest.raises(ValueError, match="codec 'zlib' is not read"):
        loads_arrays_pickle(encoded)


def test_object_arrays_are_refused():
    with pytest.raises(ValueError, match="arrays of Python objects"):
        loads_arrays_pickle(b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tS'O'\ntR.")


def test_stand_ins_keep_the_state_and_do_nothing():
    data = b"\x80\x02cchumpy.ch\nCh\n)\x81}U\x01xK\x05sb."
    value = loads_arrays_pickle(data, stand_ins=lambda module, name: module == "chumpy.ch")
    assert isinstance(value, StandIn)
    assert (value.module, value.name, value.state) == ("chumpy.ch", "Ch", {"x": 5})
    assert "chumpy.ch.Ch" in repr(value)
    with pytest.raises(ValueError, match=r"chumpy\.ch\.Ch"):
        loads_arrays_pickle(data)


def test_only_stand_ins_can_be_made_by_the_old_protocols():
    data = b"ccopy_reg\n_reconstructor\n(cnumpy\ndtype\nc__builtin__\nobject\nNtR."
    with pytest.raises(ValueError, match="only stand-ins"):
        loads_arrays_pickle(data)


@pytest.mark.parametrize("cut", [0, 1, 10, 60, -1])
def test_cut_files_are_named(tmp_path, cut: int):
    path = tmp_path / "hand.pkl"
    path.write_bytes(pickle.dumps({"v": np.zeros(10)})[:cut])
    with pytest.raises(ValueError, match=r"hand\.pkl must be a whole pickle of arrays"):
        load_arrays_pickle(path)


def test_text_and_missing_files_are_named(tmp_path):
    path = tmp_path / "readme.pkl"
    path.write_text("this is no pickle")
    with pytest.raises(ValueError, match="of another kind"):
        load_arrays_pickle(path)
    with pytest.raises(FileNotFoundError, match=r"no file at .*none\.pkl"):
        load_arrays_pickle(tmp_path / "none.pkl")


def test_persistent_objects_are_refused():
    with pytest.raises(ValueError, match="outside itself"):
        loads_arrays_pickle(b"Psomewhere\n.")


@pytest.mark.parametrize("protocol", range(6))
def test_ordered_dicts_are_read(protocol: int):
    value = OrderedDict(b=np.ones(2), a=OrderedDict(c=1))
    read = loads_arrays_pickle(pickle.dumps(value, protocol=protocol))
    assert list(read) == ["b", "a"]
    assert read["a"] == {"c": 1}
    np.testing.assert_array_equal(read["b"], value["b"])


def test_rows_of_lists_are_read_and_no_other_objects():
    rows = np.empty(2, object)
    rows[:] = [[1, 2.5], []]
    assert loads_arrays_pickle(pickle.dumps(rows)) == [[1, 2.5], []]
    for other in (np.array([{}], object), np.array([[None]], object), np.array([print], object)):
        with pytest.raises(ValueError, match=r"refused"):
            loads_arrays_pickle(pickle.dumps(other))


def test_an_array_of_one_dict_is_read_where_that_is_asked():
    one = np.empty((), object)
    one[()] = {"rot": np.arange(3.0)}
    two = np.array([{"a": 1}, {"b": 2}], dtype=object)
    text = np.empty((), object)
    text[()] = "no dict"
    held = loads_arrays_pickle(pickle.dumps(one), array_of_dict=True)
    np.testing.assert_array_equal(held[0]["rot"], np.arange(3.0))
    with pytest.raises(ValueError, match="only rows of lists are read"):
        loads_arrays_pickle(pickle.dumps(one))
    for other in (two, text):
        with pytest.raises(ValueError, match="only rows of lists are read"):
            loads_arrays_pickle(pickle.dumps(other), array_of_dict=True)
