import numpy as np

from poem_jax.weights.name_table import attention, read_rows, write_rows

ROWS = list(attention("attn", "reader"))


def leaves() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        row.path: rng.normal(size=(4, 4) if row.path.endswith("kernel") else (4,)).astype(np.float32)
        for row in ROWS
    }


def test_queries_keys_and_values_are_stacked_in_this_order():
    ours = leaves()
    state = write_rows(ROWS, ours)
    assert {name: array.shape for name, array in state.items()} == {
        "attn.in_proj_weight": (12, 4),
        "attn.in_proj_bias": (12,),
        "attn.out_proj.weight": (4, 4),
        "attn.out_proj.bias": (4,),
    }
    keys = ours["trainable.reader.key.kernel"]
    np.testing.assert_array_equal(state["attn.in_proj_weight"][4:8], keys.T)
    read, problems = read_rows(ROWS, state, ours)
    assert problems == []
    assert read.keys() == ours.keys()
    for path, array in ours.items():
        np.testing.assert_array_equal(read[path], array)


def test_the_whole_foreign_shape_is_asked_for():
    ours = leaves()
    state = write_rows(ROWS, ours)
    state["attn.in_proj_weight"] = state["attn.in_proj_weight"][:11]
    _, problems = read_rows(ROWS, state, ours)
    assert len(problems) == 3
    assert all("expected floats of shape (12, 4)" in problem for problem in problems)
