"""Tables that tie the names of a PyTorch state dict to the arrays of our models.

A `NameRow` is one row: the foreign name, the dotted path in `params`, the place in a stack of equal blocks,
and how the axes move. The tables list their rows for a config; the same rows serve import and export.
"""

import enum
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from poem_jax.typing import Array


class Axes(enum.Enum):
    """How a foreign array's axes become ours."""

    SAME = None
    TRANSPOSED = (1, 0)
    """Linear layers: (out, in) -> (in, out)."""
    OIHW_TO_HWIO = (2, 3, 1, 0)
    """Convolutions."""

    def to_ours(self, array: np.ndarray) -> np.ndarray:
        """Move the axes of a foreign array."""
        return array if self.value is None else array.transpose(self.value)

    def to_foreign(self, array: np.ndarray) -> np.ndarray:
        """Undo `to_ours`."""
        return array if self.value is None else array.transpose(np.argsort(self.value))


class NameRow(NamedTuple):
    """One row of a table."""

    source: str
    """Name in the state dict."""
    path: str
    """Dotted path in `params`, its group first."""
    axes: Axes = Axes.SAME
    index: tuple[int, ...] = ()
    """Place along the leading axes of an array that stacks the weights of equal blocks."""
    part: tuple[int, int] = (0, 1)
    """(i, n): the row takes the i-th of n equal parts of the foreign array, along its first axis. The rows of
    one source follow each other in the order of their parts."""


NameRows = Iterator[NameRow]


def linear(source: str, path: str, *, bias: bool = True) -> NameRows:
    """List a linear layer."""
    yield NameRow(f"{source}.weight", f"trainable.{path}.kernel", Axes.TRANSPOSED)
    if bias:
        yield NameRow(f"{source}.bias", f"trainable.{path}.bias")


def attention(source: str, path: str) -> NameRows:
    """List PyTorch's `MultiheadAttention`, which stacks the weights of queries, keys and values."""
    for i, part in enumerate(("query", "key", "value")):
        yield NameRow(
            f"{source}.in_proj_weight", f"trainable.{path}.{part}.kernel", Axes.TRANSPOSED, part=(i, 3)
        )
        yield NameRow(f"{source}.in_proj_bias", f"trainable.{path}.{part}.bias", part=(i, 3))
    yield from linear(f"{source}.out_proj", f"{path}.out")


def layer_norm(source: str, path: str) -> NameRows:
    """List a layer norm."""
    yield NameRow(f"{source}.weight", f"trainable.{path}.scale")
    yield NameRow(f"{source}.bias", f"trainable.{path}.bias")


def convolution(source: str, path: str, index: tuple[int, ...] = (), *, bias: bool = True) -> NameRows:
    """List a convolution."""
    yield NameRow(f"{source}.weight", f"trainable.{path}.kernel", Axes.OIHW_TO_HWIO, index)
    if bias:
        yield NameRow(f"{source}.bias", f"trainable.{path}.bias", index=index)


def batch_norm(source: str, path: str, index: tuple[int, ...] = (), *, frozen: bool = False) -> NameRows:
    """List a batch norm; all of a frozen one is among the statistics."""
    group = "statistics" if frozen else "trainable"
    for name, ours in (("weight", "scale"), ("bias", "bias")):
        yield NameRow(f"{source}.{name}", f"{group}.{path}.{ours}", index=index)
    for name, ours in (("running_mean", "statistics.{}.mean"), ("running_var", "statistics.{}.variance")):
        yield NameRow(f"{source}.{name}", ours.format(path), index=index)


def conv_norm(
    conv: str,
    norm: str,
    path: str,
    index: tuple[int, ...] = (),
    *,
    bias: bool = False,
    frozen: bool = False,
) -> NameRows:
    """List a convolution and the batch norm that follows it."""
    yield from convolution(conv, f"{path}.conv", index, bias=bias)
    yield from batch_norm(norm, f"{path}.norm", index, frozen=frozen)


def read_rows(
    rows: list[NameRow], state: dict[str, np.ndarray], template: dict[str, Array]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Fill the leaves that `rows` name from a state dict.

    Args:
        rows: the table.
        state: foreign arrays by name.
        template: shape and dtype of our leaves by dotted path.

    Returns: the leaves, and all problems: names that are missing, arrays of another shape or kind.
    """
    leaves: dict[str, np.ndarray] = {}
    problems = []
    for row in rows:
        leaf = template[row.path]
        expected = leaf.shape[len(row.index) :]
        if row.source not in state:
            problems.append(f"{row.source}: missing, expected for {row.path}")
            continue
        array, wanted = state[row.source], _foreign_shape(row, expected)
        if not _is_real(array) or array.shape != wanted:
            found = f"{array.dtype} of shape {array.shape}"
            problems.append(f"{row.source}: expected floats of shape {wanted} for {row.path}, got {found}")
            continue
        target = leaves.setdefault(row.path, np.empty(leaf.shape, leaf.dtype))
        target[row.index] = row.axes.to_ours(_taken(array, row.part))
    return leaves, problems


def write_rows(rows: list[NameRow], leaves: dict[str, Array]) -> dict[str, np.ndarray]:
    """Undo `read_rows`: return the foreign arrays by name, contiguous."""
    parts: dict[str, list[np.ndarray]] = {}
    for row in rows:
        array = row.axes.to_foreign(np.asarray(leaves[row.path])[row.index])
        parts.setdefault(row.source, []).append(array)
    return {
        source: np.ascontiguousarray(arrays[0] if len(arrays) == 1 else np.concatenate(arrays))
        for source, arrays in parts.items()
    }


def _is_real(array: np.ndarray) -> bool:
    """Whether an array holds floats; those of ml_dtypes (bfloat16) have a kind of their own."""
    return array.dtype.kind == "f" or array.dtype.name == "bfloat16"


def _taken(array: np.ndarray, part: tuple[int, int]) -> np.ndarray:
    i, count = part
    return array if count == 1 else np.split(array, count)[i]


def _foreign_shape(row: NameRow, ours: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of the whole foreign array of which the row takes a part of shape `ours`."""
    shape = tuple(int(n) for n in row.axes.to_foreign(np.empty(ours, np.bool_)).shape)
    _, count = row.part
    return shape if count == 1 else (count * shape[0], *shape[1:])
