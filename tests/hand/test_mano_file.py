"""MANO's own files may not be here: these are written by hand as the genuine ones were, stubs included."""

import pickle
import sys
from collections import OrderedDict
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy import sparse

from poem_jax.hand.mano_file import load
from poem_jax.hand.model import HandModel, hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import MANO_PARENTS


def _fields() -> dict:
    model = default_hand()
    parents = np.array(MANO_PARENTS, dtype=np.int64).astype(np.uint32)
    return {
        "v_template": model.v_template.astype(np.float64),
        "shapedirs": model.shapedirs.astype(np.float64),
        "posedirs": model.posedirs.astype(np.float64),
        "J_regressor": model.J_regressor.astype(np.float64),
        "weights": model.weights.astype(np.float64),
        "f": model.faces.astype(np.uint32),
        "kintree_table": np.stack([parents, np.arange(16, dtype=np.uint32)]),
        "hands_components": np.eye(45),
        "hands_mean": np.zeros(45),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


_OTHER_ORDERS = [
    (list(range(15, -1, -1)), ".* of the hand's length from joint"),
    ([0, 3, 2, 1, *range(4, 16)], "a joint of a finger nearer to the wrist than the one before it"),
    ([0, 1, 3, 2, *range(4, 16)], "a joint of a finger nearer to the wrist than the one before it"),
    ([0, 13, 14, 15, 1, 2, 3, 4, 5, 6, 10, 11, 12, 7, 8, 9], "a knuckle nearer to the wrist than the base"),
    ([*range(7), 10, 11, 12, 7, 8, 9, 13, 14, 15], "knuckles in another order across the palm"),
    ([0, 7, 8, 9, 10, 11, 12, *range(1, 7), 13, 14, 15], "knuckles in another order across the palm"),
]
"""And what tells: backwards, a finger backwards, two of its joints exchanged, thumb first, ring before
little finger, from the little finger to the index."""


def _in_order(order: list[int], name: str) -> dict:
    array = np.asarray(getattr(default_hand(), name), np.float64)
    return {name: array[order] if name == "J_regressor" else array[:, order]}


def _same(got: HandModel, side: str = "right") -> None:
    assert got.side == side
    for name, a, b in zip(HandModel._fields, got, default_hand(), strict=True):
        if name != "is_left":
            np.testing.assert_array_equal(a, b)
    assert got.faces.dtype == np.int32
    assert got.v_template.dtype == np.float32


@pytest.fixture
def foreign(monkeypatch) -> dict[str, type]:
    """Classes with the names of chumpy's, as the genuine file mentions them."""

    def make(module: str, name: str) -> type:
        kind = type(name, (), {"__module__": module})
        stub = ModuleType(module)
        setattr(stub, name, kind)
        monkeypatch.setitem(sys.modules, module, stub)
        return kind

    monkeypatch.setitem(sys.modules, "chumpy", ModuleType("chumpy"))
    return {"Ch": make("chumpy.ch", "Ch"), "Select": make("chumpy.reordering", "Select")}


def _with_state(kind: type, **state) -> object:
    value = kind()
    value.__dict__.update(state)
    return value


@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_reads_a_pickle_like_manos(tmp_path: Path, foreign, protocol: int, monkeypatch):
    fields = _fields()
    directions = fields["shapedirs"]
    # The genuine file selects its shape directions out of a longer array and stores a sparse regressor.
    longer = np.concatenate([directions, np.ones((778, 3, 5))], axis=-1)
    picked = np.arange(longer.size).reshape(longer.shape)[..., :10].ravel()
    fields["shapedirs"] = _with_state(
        foreign["Select"],
        a=_with_state(foreign["Ch"], x=longer, _dirty_vars=None),
        idxs=picked,
        preferred_shape=directions.shape,
    )
    fields["posedirs"] = _with_state(foreign["Ch"], x=fields["posedirs"])
    fields["J_regressor"] = sparse.csc_matrix(fields["J_regressor"])
    path = tmp_path / "MANO_RIGHT.pkl"
    data = pickle.dumps(fields, protocol=protocol, fix_imports=True)
    path.write_bytes(data.replace(b"scipy.sparse._csc\n", b"scipy.sparse.csc\n"))
    for module in ("chumpy", "chumpy.ch", "chumpy.reordering"):
        monkeypatch.delitem(sys.modules, module)
    _same(load(path))


FORMS = ("csc", "csr", "coo", "lil", "dia", "bsr")


@pytest.mark.filterwarnings("ignore:Constructing a DIA matrix")
@pytest.mark.parametrize("make", [getattr(sparse, f"{f}_{k}") for f in FORMS for k in ("matrix", "array")])
def test_reads_sparse_regressors(tmp_path: Path, make):
    path = tmp_path / "MANO_LEFT.pkl"
    path.write_bytes(pickle.dumps({**_fields(), "J_regressor": make(_fields()["J_regressor"])}))
    _same(load(path), side="left")


def test_reads_ordered_dicts(tmp_path: Path):
    path = tmp_path / "MANO_RIGHT.pkl"
    path.write_bytes(pickle.dumps(OrderedDict(_fields())))
    _same(load(path))


def _left_fields() -> dict:
    left = default_hand("left")
    names = ("v_template", "shapedirs", "posedirs")
    return {**_fields(), **{name: getattr(left, name) for name in names}, "f": left.faces}


def test_the_published_left_hand_is_mended_with_a_warning(tmp_path: Path, caplog):
    """Its `shapedirs` are those of the right hand in x; what they should be is the mirror image."""
    path = tmp_path / "MANO_LEFT.pkl"
    path.write_bytes(pickle.dumps({**_left_fields(), "shapedirs": _fields()["shapedirs"]}))
    model = load(path)
    assert model.side == "left"
    for got, expected in zip(model, default_hand("left"), strict=True):
        np.testing.assert_array_equal(got, expected)
    (message,) = caplog.messages
    assert "the x components of `shapedirs`" in message
    assert "known fault of the published MANO_LEFT.pkl" in message


@pytest.mark.parametrize(("side", "fields"), [("left", _left_fields()), ("right", _fields())])
def test_sound_hands_are_left_alone(side, fields, tmp_path: Path, caplog):
    path = tmp_path / f"MANO_{side.upper()}.pkl"
    path.write_bytes(pickle.dumps(fields))
    for got, expected in zip(load(path), default_hand(side), strict=True):
        np.testing.assert_array_equal(got, expected)
    assert caplog.messages == []


def test_a_left_hand_whose_shape_says_nothing_is_read_with_a_warning(tmp_path: Path, caplog):
    path = tmp_path / "MANO_LEFT.pkl"
    path.write_bytes(pickle.dumps({**_left_fields(), "shapedirs": np.zeros((778, 3, 10))}))
    assert not load(path).shapedirs.any()
    assert "whether they are mirrored with the hand" in caplog.text


@pytest.mark.parametrize("name", ["left_of_RIGHT.pkl", "hand.pkl"])
@pytest.mark.parametrize(("side", "fields"), [("left", _left_fields()), ("right", _fields())])
def test_the_hand_tells_its_side_where_the_name_does_not(name, side, fields, tmp_path: Path, caplog):
    path = tmp_path / name
    path.write_bytes(pickle.dumps(fields))
    assert load(path).side == side
    assert caplog.messages == []


def test_a_name_that_contradicts_the_hand_is_told(tmp_path: Path, caplog):
    path = tmp_path / "MANO_RIGHT.pkl"
    path.write_bytes(pickle.dumps(_left_fields()))
    assert load(path).side == "right"
    assert (
        "read as a right hand after its name, but its fingers point along +x as a left hand's" in caplog.text
    )


def test_reads_an_npz(tmp_path: Path):
    path = tmp_path / "hand.npz"
    np.savez(path, **_fields())
    _same(load(path))
    _same(load(path, side="left"), side="left")


def test_reads_the_reference_asset(shared_dir: Path):
    path = shared_dir / "reference/poem_v2/fake_mano.npz"
    model, stored = load(path), np.load(path)
    np.testing.assert_array_equal(model.faces, stored["f"])
    mesh = hand_mesh(model, np.zeros((16, 3)), np.zeros(10))
    np.testing.assert_allclose(mesh.vertices, stored["v_template"], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"v_template": np.zeros((6890, 3))}, r"`v_template` .* must have shape \(778, 3\); got \(6890, 3\)"),
        ({"weights": np.zeros((778, 24))}, r"`weights` .* must have shape \(778, 16\)"),
        (
            {"posedirs": "lbs"},
            "`posedirs` .* must be an array of numbers .*; got a",
        ),
        ({"v_template": np.full((778, 3), np.nan)}, "`v_template` .* must be finite"),
        ({"v_template": _fields()["v_template"] * 1000}, "must be in metres.*Divide millimetres by 1000"),
        ({"v_template": _fields()["v_template"] * 100}, "must be in metres.*centimetres by 100"),
        ({"v_template": _fields()["v_template"] / 10}, r"must be in metres; got a hand 0\.0\d+ long"),
        ({"weights": np.zeros((778, 16))}, "rows of `weights` .* must sum to 1"),
        ({"f": np.full((1538, 3), 778)}, r"`f` .* vertex numbers 0\.\.777; got 778\.\.778"),
        ({"kintree_table": np.zeros((2, 16), int)}, "`kintree_table` .* must have MANO's parents"),
        ({"kintree_table": np.zeros((0, 16), int)}, "`kintree_table` .* must have MANO's parents"),
        ({"kintree_table": "parents"}, "`kintree_table` .* must have MANO's parents"),
        ({"v_template": np.full((778, 3), 1e300)}, "`v_template` .* must be finite"),
        ({"f": np.full((1538, 3), 2**32, np.int64)}, r"`f` .* vertex numbers 0\.\.777; got 4294967296"),
        ({"f": np.full((1538, 3), np.nan)}, r"`f` .* vertex numbers 0\.\.777; got nan"),
        ({"f": np.full((1538, 3), 0.5)}, r"`f` .* vertex numbers 0\.\.777; got 0\.5"),
        ({"f": np.array([[0, 1, 2]] * 1537 + [[3, 4, 3]])}, r"`f` .*; 1 faces .* the first is \[3, 4, 3\]"),
        ({"shapedirs": 1000 * _fields()["shapedirs"]}, r"`shapedirs` .* must be in metres.*another unit"),
        ({"posedirs": 1000 * _fields()["posedirs"]}, r"`posedirs` .* must be in metres.*another unit"),
        ({"shapedirs": 100 * _fields()["shapedirs"]}, r"`shapedirs` .* must be in metres.*another unit"),
        ({"shapedirs": _fields()["shapedirs"] / 1000}, r"`shapedirs` .* must be in metres.*another unit"),
        *(
            ({**_in_order(order, "J_regressor"), **change}, f"`J_regressor` .* MANO's order .*; got {got}")
            for order, got in _OTHER_ORDERS
            for change in ({}, _in_order(order, "weights"))
        ),
        *(
            (_in_order(order, "weights"), "columns of `weights` .* order of the rows .* the other way round")
            for order, _ in [*_OTHER_ORDERS, ([0, 1, 3, 2, *range(4, 16)], "")]
        ),
        ({"weights": np.eye(1, 16).repeat(778, 0)}, "`weights` .* none follows joint 1"),
        ({"J_regressor": np.full((16, 778), 1 / 778)}, "`J_regressor` .* MANO's order"),
        ({"weights": None}, "missing: weights"),
    ],
)
def test_wrong_fields_are_named(tmp_path: Path, change: dict, message: str):
    fields = {key: value for key, value in {**_fields(), **change}.items() if value is not None}
    pickled, zipped = tmp_path / "hand.pkl", tmp_path / "hand.npz"
    pickled.write_bytes(pickle.dumps(fields))
    np.savez(zipped, **fields)
    for path in (pickled, zipped):
        with pytest.raises(ValueError, match=message):
            load(path)


def test_damaged_sparse_matrices_are_named(tmp_path: Path):
    matrix = sparse.csc_matrix(_fields()["J_regressor"])
    matrix.indices = matrix.indices + 100
    path = tmp_path / "hand.pkl"
    path.write_bytes(pickle.dumps({**_fields(), "J_regressor": matrix}))
    with pytest.raises(ValueError, match=r"`J_regressor` .* is damaged"):
        load(path)


def _sparse_with(**changes) -> sparse.csc_matrix:
    matrix = sparse.csc_matrix(_fields()["J_regressor"])
    vars(matrix).update(changes)
    return matrix


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"indptr": np.full(779, 2**60)}, "indptr must hold numbers from 0 to"),
        ({"indptr": np.zeros(779, int)}, "indptr must run from 0 to"),
        ({"indptr": np.zeros(5, int)}, "do not make a sparse matrix"),
        ({"indptr": 7}, "indptr must be a flat list of whole numbers; got a int"),
        ({"indices": [[1, 2]]}, "indices must be a flat list"),
        ({"indices": None}, "indices must be a flat list"),
        ({"_shape": (2**70, 2**70)}, "shape must be a flat list"),
        ({"_shape": (2**50, 778)}, "shape must hold numbers from 0 to 778"),
        ({"_shape": (float("inf"), 1)}, "shape must be a flat list"),
        ({"_shape": (16, 778, 1)}, "must have 2 dimensions; got 3"),
        ({"data": ["a"]}, "whose values were not found"),
    ],
)
def test_hostile_sparse_matrices_are_named(tmp_path: Path, changes: dict, message: str):
    path = tmp_path / "hand.pkl"
    path.write_bytes(pickle.dumps({**_fields(), "J_regressor": _sparse_with(**changes)}))
    with pytest.raises(ValueError, match=rf"`J_regressor` in .*{message}"):
        load(path)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"preferred_shape": (float("inf"), 3)}, "preferred_shape must be a flat list of whole numbers"),
        ({"preferred_shape": (10**400,)}, "preferred_shape must be a flat list"),
        ({"preferred_shape": (-1, 3)}, "preferred_shape must hold numbers from 0"),
        ({"preferred_shape": (1,) * 40}, "preferred_shape must arrange 2 values"),
        ({"preferred_shape": 5}, "preferred_shape must be a flat list"),
        ({"idxs": [2**70]}, "idxs must be a flat list"),
        ({"idxs": [-1]}, "idxs must hold numbers from 0 to 9"),
        ({"idxs": np.array([10])}, "idxs must hold numbers from 0 to 9"),
        ({"idxs": {"a": 1}}, "idxs must be a flat list of whole numbers; got a dict"),
    ],
)
def test_hostile_selections_are_named(tmp_path: Path, foreign, state: dict, message: str):
    inner = _with_state(foreign["Ch"], x=np.arange(10.0))
    parts = {"a": inner, "idxs": [0, 1], "preferred_shape": (1, 2), **state}
    path = tmp_path / "hand.pkl"
    path.write_bytes(pickle.dumps({**_fields(), "shapedirs": _with_state(foreign["Select"], **parts)}))
    with pytest.raises(ValueError, match=rf"`shapedirs` in .* is damaged: {message}"):
        load(path)


def test_selections_of_themselves_are_named(tmp_path: Path, foreign):
    own = _with_state(foreign["Select"], idxs=[0])
    own.__dict__["a"] = own
    path = tmp_path / "hand.pkl"
    for field in ("shapedirs", "kintree_table"):
        path.write_bytes(pickle.dumps({**_fields(), field: own}))
        with pytest.raises(ValueError, match=rf"`{field}` in .* select from each other more than 8 deep"):
            load(path)


def test_empty_chumpy_variables_are_named(tmp_path: Path, foreign):
    path = tmp_path / "hand.pkl"
    path.write_bytes(pickle.dumps({**_fields(), "shapedirs": _with_state(foreign["Ch"], y=1)}))
    with pytest.raises(ValueError, match=r"`shapedirs` .* chumpy\.ch\.Ch whose values were not found"):
        load(path)


def test_hostile_pickles_are_refused(tmp_path: Path):
    path = tmp_path / "MANO_RIGHT.pkl"
    path.write_bytes(b"cos\nsystem\n(S'touch hostile'\ntR.")
    with pytest.raises(ValueError, match=r"asks for os\.system, which .* is refused"):
        load(path)


def test_other_files_are_named(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"no hand model at .*give MANO_RIGHT\.pkl"):
        load(tmp_path / "MANO_RIGHT.pkl")
    text = tmp_path / "notes.npz"
    text.write_text("no archive")
    with pytest.raises(ValueError, match=r"notes\.npz must be an npz of plain arrays"):
        load(text)
    whole = tmp_path / "whole.npz"
    np.savez(whole, **_fields())
    cut = tmp_path / "cut.npz"
    cut.write_bytes(whole.read_bytes()[:5000])
    with pytest.raises(ValueError, match="cut short, damaged or of another kind"):
        load(cut)
    array = tmp_path / "list.pkl"
    array.write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(ValueError, match="dictionary of MANO's fields; got a list"):
        load(array)
    single = tmp_path / "single.npz"
    with single.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(ValueError, match=r"one array without a name \(\.npy\); save it with numpy"):
        load(single)
    other = tmp_path / "hand.obj"
    other.write_text("v 0 0 0")
    with pytest.raises(ValueError, match=r"must end in \.pkl or \.npz; got '\.obj'"):
        load(other)
    with pytest.raises(ValueError, match="`side` must be"):
        load(whole, side="both")
