"""SciPy's sparse matrices out of a pickle: the matrix, or a ValueError that names what does not fit."""

import pickle

import numpy as np
import pytest
from scipy import sparse

from poem_jax.io.safe_pickle import loads_arrays_pickle
from poem_jax.io.sparse_matrices import dense_matrix, is_sparse_matrix

FORMS = ("csc", "csr", "coo", "lil", "dia", "bsr")
MATRIX = np.random.default_rng(0).integers(-2, 3, (6, 9)) * 0.5
MATRIX[2] = 0


def read(matrix, max_side: int = 10):
    return dense_matrix(loads_arrays_pickle(pickle.dumps(matrix), stand_ins=is_sparse_matrix), max_side)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int32])
def test_every_form_gives_the_matrix_back(form, dtype):
    matrix = (2 * MATRIX).astype(dtype)
    np.testing.assert_array_equal(read(getattr(sparse, f"{form}_matrix")(matrix)), matrix)


def test_blocks_and_entries_at_one_place():
    blocks = sparse.bsr_matrix(MATRIX, blocksize=(2, 3))
    np.testing.assert_array_equal(read(blocks), MATRIX)
    twice = sparse.coo_matrix(([1.0, 2.0], ([0, 0], [1, 1])), shape=(2, 2))
    np.testing.assert_array_equal(read(twice), twice.toarray())
    old = sparse.coo_matrix(MATRIX)
    vars(old).update(row=old.row, col=old.col)
    del vars(old)["coords"]  # as SciPy wrote it before 1.13
    np.testing.assert_array_equal(read(old), MATRIX)


def test_a_long_side_is_refused():
    with pytest.raises(ValueError, match="shape must hold numbers from 0 to 8; got 6 to 9"):
        read(sparse.coo_matrix(MATRIX), max_side=8)


def rows(*lists) -> np.ndarray:
    made = np.empty(len(lists), object)
    made[:] = lists
    return made


LONG = list(range(10**4))
HOSTILE = {
    "coo rows": (
        "coo",
        {"coords": (np.array([6]), np.array([0]))},
        "rows must hold numbers from 0 to 5; got 6",
    ),
    "coo columns": (
        "coo",
        {"coords": (np.array([0]), np.array([-1]))},
        "columns must hold numbers from 0 to 8",
    ),
    "coo counts": (
        "coo",
        {"coords": (np.array([0]), np.array([0]))},
        "values must have as many rows and columns",
    ),
    "coo without": ("coo", {"coords": None}, "coords must be a pair"),
    "coo values": ("coo", {"data": np.zeros((2, 2))}, "data must be a flat array of numbers"),
    "csr scalar": ("csr", {"data": np.array(1.0)[()]}, None),
    "csr values": ("csr", {"data": np.zeros((2, 2))}, "data must be a flat array of numbers"),
    "lil rows": ("lil", {"rows": 5}, "rows and data must be 6 lists each"),
    "lil lengths": ("lil", {"data": rows(*[[1.0]] * 6)}, "and one of as many values"),
    "lil long": ("lil", {"rows": rows(*[LONG] * 6), "data": rows(*[LONG] * 6)}, "at most 9 columns"),
    "lil columns": ("lil", {"rows": rows([9], *[[]] * 5), "data": rows([1], *[[]] * 5)}, "columns must hold"),
    "lil text": (
        "lil",
        {"rows": rows([1], *[[]] * 5), "data": rows(["a"], *[[]] * 5)},
        "must be numbers; got a str",
    ),
    "lil huge": (
        "lil",
        {"rows": rows([1], *[[]] * 5), "data": rows([10**400], *[[]] * 5)},
        "must be numbers; got a int",
    ),
    "dia offsets": ("dia", {"offsets": [1]}, "flat list of offsets"),
    "dia far": ("dia", {"offsets": np.full(1, -(2**63)), "data": np.ones((1, 9))}, "nothing"),
    "bsr blocks": ("bsr", {"data": np.ones((1, 4, 5))}, "blocks of 4 x 5 do not fill a matrix of shape"),
    "bsr empty": ("bsr", {"data": np.ones((1, 0, 5))}, "data must be blocks"),
    "bsr flat": ("bsr", {"data": np.ones(5)}, "data must be blocks"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_parts_that_do_not_fit_are_named(case):
    form, changes, message = HOSTILE[case]
    matrix = getattr(sparse, f"{form}_matrix")(MATRIX)
    vars(matrix).update(changes)
    if message == "nothing":
        assert not read(matrix).any()
    elif message is None:
        assert read(matrix) is None
    else:
        with pytest.raises(ValueError, match=message):
            read(matrix)
