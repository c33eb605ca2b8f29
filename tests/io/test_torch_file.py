"""PyTorch's files, in both forms, written by hand; real torch joins where it is installed."""

import io
import pickle
import struct
import subprocess
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable

import ml_dtypes
import numpy as np
import pytest

from poem_jax.io.torch_file import load_state_dict, save_state_dict
from tests.torch_pickles import (
    MAGIC,
    call,
    dict_of,
    legacy_bytes,
    name,
    ordered,
    plain,
    storage,
    tensor,
    tuple_of,
    zip_bytes,
)

FORMS = ("zip", "legacy")
DTYPES = {
    "Half": np.float16,
    "Float": np.float32,
    "Double": np.float64,
    "BFloat16": ml_dtypes.bfloat16,
    "Char": np.int8,
    "Short": np.int16,
    "Int": np.int32,
    "Long": np.int64,
    "Byte": np.uint8,
    "Bool": np.bool_,
}

NUMBERS = {"0": np.arange(12, dtype=np.float32)}


@pytest.fixture
def read(tmp_path) -> Callable[..., dict[str, np.ndarray]]:
    """Write a file of a form from operations and read it again."""

    def read_file(form: str, operations: bytes, storages: dict = NUMBERS) -> dict[str, np.ndarray]:
        path = tmp_path / "model.pth.tar"
        path.write_bytes((zip_bytes if form == "zip" else legacy_bytes)(operations, storages))
        return load_state_dict(path)

    return read_file


def same_bits(got: np.ndarray, expected: np.ndarray) -> bool:
    return (got.dtype, got.shape, got.tobytes()) == (expected.dtype, expected.shape, expected.tobytes())


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    """Random bits of every type, NaN included, and shapes of every kind."""
    bits = np.random.default_rng(0).integers(0, 256, (3, 4, 8), dtype=np.uint8)
    arrays = {f"module.{kind}": bits.view(dtype) for kind, dtype in DTYPES.items() if kind != "Bool"}
    arrays["bool"] = bits > 100
    arrays["num_batches_tracked"] = np.array(7, np.int64)
    arrays["empty"] = np.zeros((0, 3), np.float32)
    return arrays


def test_written_arrays_come_back_bit_by_bit(tmp_path, arrays):
    save_state_dict(tmp_path / "a.pth", arrays)
    back = load_state_dict(tmp_path / "a.pth")
    assert list(back) == list(arrays)
    assert all(same_bits(back[key], arrays[key]) for key in arrays)
    save_state_dict(tmp_path / "b.pth", back)
    assert (tmp_path / "a.pth").read_bytes() == (tmp_path / "b.pth").read_bytes()


def test_any_layout_is_written(tmp_path):
    array = np.arange(24, dtype=np.int32).reshape(2, 3, 4)
    save_state_dict(tmp_path / "a.pth", {"t": array.T, "step": array[:, ::2], "big": array.astype(">i4")})
    back = load_state_dict(tmp_path / "a.pth")
    assert same_bits(back["t"], np.ascontiguousarray(array.T))
    assert same_bits(back["step"], np.ascontiguousarray(array[:, ::2]))
    assert same_bits(back["big"], array)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({}, "must hold at least one array"),
        ({"a": np.zeros(1), 3: np.zeros(1)}, "keys of `arrays` must be text; got a int"),
        ({"a": np.zeros(1, np.uint32)}, "array 'a' must be of float16, .* got uint32"),
        ({"a": np.array([None])}, "array 'a' must be of .* got object"),
    ],
)
def test_what_cannot_be_written_is_named(tmp_path, arrays, message: str):
    with pytest.raises(ValueError, match=message):
        save_state_dict(tmp_path / "a.pth", arrays)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", DTYPES)
def test_every_type_is_read(read, form: str, kind: str):
    expected = np.array([0, 1, 1, 0, 1]).astype(DTYPES[kind])
    stored = storage(form, numel=5, kind=name("torch", f"{kind}Storage"))
    back = read(form, ordered({"module.a": tensor(stored, (5,))}), {"0": expected})
    assert same_bits(back["module.a"], expected)


@pytest.mark.parametrize("form", FORMS)
def test_views_are_read_as_copies(read, form: str):
    views = {
        "whole": ((3, 4), (4, 1), 0),
        "transposed": ((4, 3), (1, 4), 0),
        "steps": ((2, 2), (4, 2), 1),
        "scalar": ((), (), 11),
        "expanded": ((2, 3), (0, 1), 4),
        "empty": ((0, 3), (3, 1), 12),
    }
    stored = storage(form)
    back = read(form, dict_of({key: tensor(stored, *view) for key, view in views.items()}))
    whole = NUMBERS["0"].reshape(3, 4)
    expected = {"whole": whole, "transposed": whole.T, "steps": whole[:2, 1::2], "scalar": whole[2, 3]}
    expected |= {"expanded": np.array([[4, 5, 6]] * 2, np.float32), "empty": np.zeros((0, 3), np.float32)}
    for key, array in back.items():
        assert same_bits(array, np.asarray(expected[key], order="C")), key
        array[...] = 0
    assert back["whole"].shape == (3, 4)


def test_parts_of_legacy_storages_are_read(read):
    stored = storage("legacy", part=("1", 4, 6))
    back = read("legacy", dict_of({"a": tensor(stored, (2, 2), (2, 1), 1)}))
    np.testing.assert_array_equal(back["a"], [[5, 6], [7, 8]])
    with pytest.raises(ValueError, match="reaches number 7 of a storage of 6"):
        read("legacy", dict_of({"a": tensor(stored, (6,), (1,), 1)}))
    with pytest.raises(ValueError, match="6 numbers from 7 on leave a storage of 12"):
        read("legacy", dict_of({"a": tensor(storage("legacy", part=("1", 7, 6)))}))
    with pytest.raises(ValueError, match="a part of a storage must be"):
        read("legacy", dict_of({"a": tensor(storage("legacy", part="1"))}))


@pytest.mark.parametrize("form", FORMS)
def test_old_ways_to_say_it_are_read(read, form: str):
    stored, floats = storage(form), tensor(storage(form))
    old = call(name("torch._utils", "_rebuild_tensor"), stored, plain(0), plain((2,)), plain((1,)))
    parameter = call(name("torch._utils", "_rebuild_parameter"), floats, plain(True), plain(None))
    size = call(name("torch", "Size"), plain((2,)))
    view = (plain(1), size, plain((1,)), plain(False), plain(None))
    sized = call(name("torch._utils", "_rebuild_tensor_v2"), stored, *view)
    pairs = b"](" + b"".join(
        b"](" + plain(key) + value + b"e" for key, value in (("a", old), ("b", parameter), ("c", sized))
    )
    python2 = call(name("collections", "OrderedDict"), pairs + b"e")
    back = read(form, python2 + dict_of({"_metadata": plain(None)}) + b"b")
    assert {key: len(array) for key, array in back.items()} == {"a": 2, "b": 12, "c": 2}
    with pytest.raises(ValueError, match="pairs of key and value"):
        read(form, call(name("collections", "OrderedDict"), plain([1])))
    with pytest.raises(ValueError, match="a size must be a tuple"):
        read(form, call(name("torch", "Size"), plain(2)))
    with pytest.raises(ValueError, match="attributes of a dict must come in a dict"):
        read(form, python2 + plain((None, {})) + b"b")
    with pytest.raises(ValueError, match="a parameter must be a tensor; got a int"):
        read(form, call(name("torch._utils", "_rebuild_parameter"), plain(3), plain(True), plain(None)))
    negated = call(name("torch._utils", "_rebuild_tensor_v2"), stored, *view, plain({"neg": True}))
    with pytest.raises(ValueError, match="pending negation"):
        read(form, negated)


def beside(form: str) -> dict[str, bytes]:
    """What training leaves beside a state dict."""
    floats = tensor(storage(form))
    state = plain({}) + plain(0) + dict_of({"step": plain(3), "exp_avg": floats}) + b"s"
    return {
        "epoch": plain(7),
        "best": plain(np.float64(0.5)),
        "optimizer": dict_of(
            {"state": state, "param_groups": plain([{"lr": 1e-4, "params": [0], "x": None}])}
        ),
        "scheduler": dict_of({"milestones": call(name("collections", "Counter"), plain({30: 1}))}),
        "args": name("argparse", "Namespace") + b")\x81" + plain({"lr": 0.1}) + b"b",
        "device": call(name("torch", "device"), plain("cuda"), plain(0)),
        "dtype": name("torch", "float32"),
        "bytes": storage(form, kind=name("torch.storage", "UntypedStorage"), key="1", numel=4),
        "loss": floats,
    }


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "outer",
    [
        lambda state, form: state,
        lambda state, form: dict_of({"state_dict": state, **beside(form)}),
        lambda state, form: dict_of({**beside(form), "model": state, "ema": state}),
        lambda state, form: dict_of({"mine": state, **beside(form)}),
        lambda state, form: dict_of({"mine": state, "loss": tensor(storage(form))}),
        lambda state, form: dict_of({"net": state, "c": tensor(storage(form))}),
        lambda state, form: state + plain("epoch") + plain(1) + b"s",
        lambda state, form: state + plain("extra") + dict_of({"c": tensor(storage(form))}) + b"s",
    ],
)
def test_the_state_dict_is_found(read, form: str, outer):
    state = ordered({"a": tensor(storage(form)), "b": tensor(storage(form), (2,))})
    operations = outer(state, form)
    untyped = {"1": np.arange(4, dtype=np.uint8)} if b"UntypedStorage" in operations else {}
    assert list(read(form, operations, NUMBERS | untyped)) == ["a", "b"]


@pytest.mark.parametrize("form", FORMS)
def test_numpy_arrays_in_a_state_dict_are_read(read, form: str):
    array = np.arange(6.0).reshape(2, 3)
    operations = dict_of({"a": plain(array), "b": plain(np.float32(2)), "c": tensor(storage(form))})
    back = read(form, operations)
    assert same_bits(back["a"], array)
    assert same_bits(back["b"], np.array(2, np.float32))


@pytest.mark.parametrize("form", FORMS)
def test_files_without_one_state_dict_are_named(read, form: str):
    floats = tensor(storage(form))
    with pytest.raises(ValueError, match="must hold a dict; got a PickledTensor"):
        read(form, floats)
    two = {"generator": dict_of({"a": floats}), "critic": dict_of({"a": floats}), "epoch": plain(1)}
    with pytest.raises(
        ValueError, match=r"keys are 'generator', 'critic', 'epoch', .* arrays 'generator', 'critic'"
    ):
        read(form, dict_of(two))
    with pytest.raises(ValueError, match="its keys are 'a', and those of dicts of arrays none"):
        read(form, plain({"a": 1}), {})
    with pytest.raises(ValueError, match=r"its keys are 0, .* 11, \.\.\., and"):
        read(form, plain(dict.fromkeys(range(20))), {})


def test_big_endian_archives_are_read(tmp_path):
    path = tmp_path / "big.pth"
    operations = dict_of({"a": tensor(storage("zip"))})
    path.write_bytes(zip_bytes(operations, {"0": NUMBERS["0"].astype(">f4")}, order="big"))
    assert same_bits(load_state_dict(path)["a"], NUMBERS["0"])
    path.write_bytes(zip_bytes(operations, NUMBERS, order=None, root="other"))
    assert same_bits(load_state_dict(path)["a"], NUMBERS["0"])
    path.write_bytes(zip_bytes(operations, NUMBERS, order="middle"))
    with pytest.raises(ValueError, match=r"byte order .* must be little or big; got b'middle'"):
        load_state_dict(path)


# Damaged files, and files of other kinds.


@pytest.mark.parametrize("form", FORMS)
def test_cut_files_are_named(tmp_path, form: str):
    operations = dict_of({"state_dict": ordered({"a": tensor(storage(form))}), "epoch": plain(3)})
    whole = (zip_bytes if form == "zip" else legacy_bytes)(operations, NUMBERS)
    path = tmp_path / "cut.pth"
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"cut\.pth"):
            load_state_dict(path)
    path.write_bytes(whole)
    assert list(load_state_dict(path)) == ["a"]


@pytest.mark.parametrize("form", FORMS)
def test_changed_bytes_never_raise_anything_else(tmp_path, form: str):
    operations = dict_of({"state_dict": ordered({"a": tensor(storage(form))}), "epoch": plain(3)})
    whole = (zip_bytes if form == "zip" else legacy_bytes)(operations, NUMBERS)
    path, refused = tmp_path / "changed.pth", 0
    for position in range(len(whole)):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x81]) + whole[position + 1 :])
        try:
            load_state_dict(path)
        except ValueError:
            refused += 1
    assert refused > len(whole) / 2


def test_changed_numbers_of_an_archive_are_named(tmp_path):
    path = tmp_path / "a.pth"
    save_state_dict(path, {"a": np.full(9, 0x5A5A5A5A, np.int32)})
    path.write_bytes(path.read_bytes().replace(b"Z" * 36, b"Z" * 35 + b"Y"))
    with pytest.raises(ValueError, match="Bad CRC-32"):
        load_state_dict(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is no file of torch.save, or cut short"),
        (b"version https://git-lfs.github.com/spec/v1", "is no file of torch.save, or cut short"),
        (pickle.dumps({"a": np.zeros(3)}), "starts neither as a zip archive nor with torch's magic number"),
        (pickle.dumps(MAGIC, 2) + pickle.dumps(1000, 2), "and protocol 1001"),
        (zip_bytes(plain(1), {}, root="a/b"), "not of torch.save: expected one data.pkl, got 0"),
        (
            zip_bytes(plain({}), NUMBERS, compression=zipfile.ZIP_DEFLATED),
            "'archive/data.pkl' in .* is compressed",
        ),
    ],
)
def test_other_files_are_named(tmp_path, content: bytes, message: str):
    path = tmp_path / "other.pth"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load_state_dict(path)


def test_torchscript_and_missing_files_are_named(tmp_path):
    path = tmp_path / "script.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("script/data.pkl", b"\x80\x02}.")
        archive.writestr("script/constants.pkl", b"\x80\x02).")
    with pytest.raises(ValueError, match=r"TorchScript .*torch\.save\(model\.state_dict\(\), path\)"):
        load_state_dict(path)
    with pytest.raises(FileNotFoundError, match=r"no file at .*none\.pth"):
        load_state_dict(tmp_path / "none.pth")


def test_archives_that_say_more_than_they_hold_are_refused(tmp_path):
    path = tmp_path / "a.pth"
    stream = io.BytesIO(zip_bytes(dict_of({"a": tensor(storage("zip"))}), NUMBERS))
    with zipfile.ZipFile(stream, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("archive/data/0", bytes(48))
    path.write_bytes(stream.getvalue())
    with pytest.raises(ValueError, match="two files of one name"):
        load_state_dict(path)
    path.write_bytes(
        zip_bytes(plain({}), {}).replace(struct.pack("<II", 2, 2), struct.pack("<II", 2**31, 2**31))
    )
    with pytest.raises(ValueError, match="says that it holds more than its"):
        load_state_dict(path)


def test_legacy_storages_must_be_those_of_the_pickle(read):
    floats = dict_of({"a": tensor(storage("legacy"))})
    with pytest.raises(ValueError, match="must hold the 1 storages that its pickle names"):
        read("legacy", floats, {})
    with pytest.raises(ValueError, match="must hold the 1 storages"):
        read("legacy", floats, {"1": NUMBERS["0"]})
    with pytest.raises(ValueError, match="must list the keys"):
        read("legacy", floats, {(1,): NUMBERS["0"]})
    with pytest.raises(ValueError, match="must have 12 numbers; got 13"):
        read("legacy", floats, {"0": np.zeros(13, np.float32)})
    two = dict_of({"a": tensor(storage("legacy")), "b": tensor(storage("legacy", numel=13))})
    with pytest.raises(ValueError, match="has two types or sizes"):
        read("legacy", two)


# Hostile files.


def hostile(form: str, trace: str) -> dict[str, tuple[bytes, str]]:
    """Operations that would run something or leave their storage, and what is said to them."""
    stored, command = storage(form), plain(f"touch {trace}")
    floats = tensor(stored)
    system = name("os", "system")
    key = (plain("0"), plain("cpu"), plain(12)) + ((plain(None),) if form == "legacy" else ())
    rebuild = name("torch._utils", "_rebuild_tensor_v2")
    return {
        "os.system": (call(system, command), "asks for os.system, .* is refused"),
        "posix.system": (call(name("posix", "system"), command), "asks for posix.system"),
        "eval": (call(name("builtins", "eval"), plain(f"open({trace!r}, 'w')")), "asks for builtins.eval"),
        "exec of Python 2": (call(name("__builtin__", "exec"), plain("1")), "asks for __builtin__.exec"),
        "stack global": (plain("os") + plain("system") + b"\x93" + tuple_of(command) + b"R", "os.system"),
        "inst": (b"(" + command + b"ios\nsystem\n", "os.system"),
        "obj": (b"(" + system + command + b"o", "os.system"),
        "dotted name": (
            call(name("torch", "FloatStorage.__class__"), command),
            "asks for torch.FloatStorage.__c",
        ),
        "bytes of a torch file": (
            name("torch.storage", "_load_from_bytes"),
            "asks for torch.storage._load_from",
        ),
        "another pickle": (name("torch.serialization", "load"), "asks for torch.serialization.load"),
        "a model": (name("models", "Net") + b")\x81", r"save `model\.state_dict\(\)` alone"),
        "storage of a strange type": (tuple_of(plain("storage"), system, *key) + b"Q", "os.system"),
        "storage of no type": (
            tuple_of(plain("storage"), plain("x"), *key) + b"Q",
            "a type of torch's storages",
        ),
        "module by its id": (
            tuple_of(plain("module"), plain("x"), *key) + b"Q",
            "must be a storage, named as",
        ),
        "id of text": (b"Pos.system\n", "must be a storage, named as"),
        "id of a list": (plain(["storage"]) + b"Q", "must be a storage, named as"),
        "key of a number": (storage(form, key=0), "key must be text; got a int"),
        "NEWOBJ of a type": (name("torch", "FloatStorage") + b")\x81", "TypeError"),
        "NEWOBJ of a maker": (name("collections", "OrderedDict") + b")\x81", "TypeError"),
        "NEWOBJ_EX": (name("collections", "OrderedDict") + b")}\x92", "TypeError"),
        "call of a type": (call(name("torch", "FloatStorage"), plain(5)), "may not be called"),
        "call of a tensor": (floats + tuple_of(command) + b"R", "not callable"),
        "BUILD on a tensor": (floats + plain({"array": 1}) + b"b", "a finished tensor may not be changed"),
        "BUILD of slots": (floats + plain((None, {"shape": (99,)})) + b"b", "a finished tensor may not be"),
        "BUILD on a storage": (stored + plain({"numel": 10**6}) + b"b", "a storage may not be changed"),
        "BUILD on a type": (name("torch", "FloatStorage") + plain({"dtype": 1}) + b"b", "may not be changed"),
        "BUILD on a maker": (rebuild + plain((None, {"_build": 1})) + b"b", "may not be changed"),
        "BUILD on a dict": (plain({}) + plain({"__class__": 1}) + b"b", "AttributeError"),
        "extension": (b"\x82\x01", "registered extension"),
        "tensor of a list": (tensor(plain([1])), "must look at a storage; got a list"),
        "offset": (tensor(stored, (12,), (1,), 1), "reaches number 13 of a storage of 12"),
        "huge offset": (tensor(stored, (1,), (1,), 2**62), "an offset and one stride"),
        "negative offset": (tensor(stored, (1,), (1,), -1), "none negative"),
        "negative stride": (tensor(stored, (2,), (-1,), 5), "none negative"),
        "stride": (tensor(stored, (3, 2), (5, 2)), "reaches number 13"),
        "stride of another count": (tensor(stored, (3, 2), (1,)), "one stride for each axis"),
        "size": (tensor(stored, (4, 4), (4, 1)), "reaches number 16"),
        "size of text": (tensor(stored, "12", (1,)), "must be a tuple of sizes"),
        "size of a bool": (tensor(stored, (True,), (1,)), "must be a tuple of sizes"),
        "size beyond numbers": (tensor(stored, (2**70,), (0,)), "must be a tuple of sizes"),
        "sizes that overflow": (tensor(stored, (2**33, 2**33), (0, 0)), "beyond any file's size"),
        "sizes beside a zero": (tensor(stored, (0, 2**40, 2**40), (1, 1, 1)), "beyond any file's size"),
        "many axes": (tensor(stored, (1,) * 60, (1,) * 60), "must be a tuple of sizes"),
        "expanded bomb": (dict_of({"a": tensor(stored, (2**30,), (0,))}), "would take 4294967296 bytes"),
        "negative count": (tensor(storage(form, numel=-1)), "must have a count of numbers"),
        "count of text": (tensor(storage(form, numel="12")), "must have a count of numbers"),
        "huge count": (
            dict_of({"a": tensor(storage(form, numel=2**38))}),
            "must have 1099511627776 b|cut short",
        ),
        "larger type": (
            dict_of({"a": tensor(storage(form, kind=name("torch", "DoubleStorage")))}),
            "must have 96 bytes; got 48|cut short",
        ),
        "unknown key": (
            dict_of({"a": tensor(storage(form, key="9"))}),
            "must have 48 bytes; got 0|must hold the 1",
        ),
        "key that climbs": (dict_of({"a": tensor(storage(form, key="../version"))}), "got 0|must hold the 1"),
        "key of a dict": (
            b"}" + floats + plain(1) + b"s",
            "keys must be text or numbers; got a PickledTensor",
        ),
        "one list copied again and again": (
            plain(list(range(20_000))) + b"q\x00" + call(name("torch", "Size"), b"h\x00") * 100,
            "uses the same contents again and again",
        ),
    }


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("attempt", hostile("zip", ""))
def test_hostile_files_are_refused_and_run_nothing(tmp_path, read, form: str, attempt: str):
    trace = tmp_path / "ran"
    operations, message = hostile(form, str(trace))[attempt]
    with pytest.raises(ValueError, match=message):
        read(form, operations)
    assert not trace.exists()


@pytest.mark.parametrize("place", range(5))
def test_nothing_runs_from_any_pickle_of_a_legacy_file(tmp_path, place: int):
    trace = tmp_path / "ran"
    evil = b"\x80\x02" + call(name("os", "system"), plain(f"touch {trace}")) + b"."
    pickles = [pickle.dumps(value, protocol=2) for value in (MAGIC, 1001, {}, {"a": 1}, [])]
    path = tmp_path / "evil.pth"
    path.write_bytes(b"".join([*pickles[:place], evil, *pickles[place + 1 :]]))
    with pytest.raises(ValueError, match=r"asks for os\.system"):
        load_state_dict(path)
    assert not trace.exists()


def test_reading_loads_neither_jax_nor_refused_modules(tmp_path):
    path = tmp_path / "evil.pth"
    path.write_bytes(zip_bytes(name("antigravity", "geohash"), {}))
    code = f"""
import sys
from poem_jax.io.torch_file import load_state_dict
try:
    load_state_dict({str(path)!r})
except ValueError as error:
    assert "antigravity.geohash" in str(error)
    sys.exit(bool({{"jax", "torch", "antigravity"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# The real thing, where it is installed.


def bits_of(tensor) -> np.ndarray:
    """What a torch tensor holds, as an array."""
    import torch

    tensor = tensor.detach().contiguous()
    if tensor.dtype == torch.bfloat16:
        return tensor.view(torch.int16).numpy().view(ml_dtypes.bfloat16)
    return tensor.numpy()


def torch_state() -> OrderedDict:
    """A state dict with tensors of every type and layout."""
    import torch

    numbers = torch.arange(120).reshape(2, 3, 4, 5)
    kinds = ("float16", "float32", "float64", "bfloat16", "int8", "int16", "int32", "int64", "uint8", "bool")
    state = OrderedDict((f"module.{kind}", numbers.to(getattr(torch, kind))) for kind in kinds)
    floats = numbers.float()
    state |= {"step": floats[1, ::2, 1:3], "turned": floats.permute(3, 1, 0, 2), "tied": floats}
    state |= {
        "expanded": torch.ones(3, 1).expand(3, 4),
        "empty": torch.zeros(0, 3),
        "scalar": torch.tensor(7),
    }
    state |= {"parameter": torch.nn.Parameter(torch.ones(2)), "odd": torch.tensor([float("nan"), -0.0])}
    state._metadata = OrderedDict({"": {"version": 1}})  # type: ignore[attr-defined]
    return state


@pytest.mark.parametrize("is_zip", [True, False])
@pytest.mark.parametrize("protocol", [2, 4])
def test_files_of_torch_are_read(tmp_path, is_zip: bool, protocol: int):
    torch = pytest.importorskip("torch")
    model = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4))
    optimizer = torch.optim.AdamW(model.parameters())
    model(torch.ones(2, 3)).sum().backward()
    optimizer.step()
    scheduler = torch.optim.lr_scheduler.MultiStepLR(optimizer, [3, 5])
    others = {
        "optimizer": optimizer.state_dict(),
        "scheduler": scheduler.state_dict(),
        "rng": torch.get_rng_state(),
    }
    state, path = torch_state(), tmp_path / "model.pth.tar"
    for content in (state, {"state_dict": state, "model": model.state_dict(), "epoch": 3, **others}):
        torch.save(content, path, _use_new_zipfile_serialization=is_zip, pickle_protocol=protocol)
        back = load_state_dict(path)
        assert list(back) == list(state)
        assert all(same_bits(back[key], bits_of(state[key])) for key in state)


def test_torch_reads_what_is_written(tmp_path, arrays):
    torch = pytest.importorskip("torch")
    save_state_dict(tmp_path / "a.pth", arrays)
    back = torch.load(tmp_path / "a.pth", weights_only=True)
    assert type(back) is OrderedDict
    assert list(back) == list(arrays)
    assert all(same_bits(bits_of(back[key]), arrays[key]) for key in arrays)


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_scripts_and_whole_models_of_torch_are_named(tmp_path):
    torch = pytest.importorskip("torch")
    model, path = torch.nn.Linear(2, 2), tmp_path / "model.pt"
    torch.save(model, path)
    with pytest.raises(ValueError, match=r"asks for torch\.nn\.modules\.linear\.Linear"):
        load_state_dict(path)
    stream = io.BytesIO()
    torch.jit.save(torch.jit.trace(model, torch.ones(1, 2)), stream)
    path.write_bytes(stream.getvalue())
    with pytest.raises(ValueError, match="TorchScript"):
        load_state_dict(path)
