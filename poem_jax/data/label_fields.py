"""Fields of a label that nobody vouches for, as arrays of a known shape or an error that names the sample."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.data.frames import CorruptSampleError
from poem_jax.typing import Array, Float


class LabelFields:
    """The fields of one label, checked as they are asked for."""

    def __init__(self, label: Any, views: int, path: str | Path, key: str) -> None:
        self._views, self._path, self._key = views, path, key
        if not isinstance(label, Mapping):
            raise self.error(f"label.pyd must hold a dictionary; got a {type(label).__name__}")
        self._label = label

    def error(self, problem: str) -> CorruptSampleError:
        """Return an error about this sample."""
        return CorruptSampleError(self._path, self._key, problem)

    def has(self, name: str) -> bool:
        """Say whether there is such a field."""
        return name in self._label

    def flag(self, name: str) -> bool:
        """Return a truth value of the sample; False where it is absent."""
        value = self._label.get(name, False)
        if not isinstance(value, bool | int | np.bool_):
            raise self.error(f"`{name}` must be one truth value for all views; got a {type(value).__name__}")
        return bool(value)

    def array(self, name: str, shape: tuple[int, ...], *, cut: bool = False) -> Float[Array, "view ..."]:
        """Return a field as (view, *shape), finite float64, however its entries are shaped.

        Args:
            name: Of the field.
            shape: In each view.
            cut: Numbers beyond those of `shape` may follow in each view, and are left out.

        Raises:
            CorruptSampleError: It is missing, has not one entry a view, or other numbers.
        """
        entries = self._entries(name)
        try:
            array = np.stack([np.asarray(entry, np.float64).reshape(-1) for entry in entries])
        except (TypeError, ValueError) as error:
            raise self.error(f"`{name}` must be numbers {shape} for each view: {error}") from error
        count = int(np.prod(shape))
        if array.shape[1] < count or (array.shape[1] > count and not cut):
            got = np.shape(entries[0])
            raise self.error(f"`{name}` must have shape {shape} in each view; got {got}")
        array = array[:, :count]
        if not np.isfinite(array).all():
            views = ", ".join(map(str, np.flatnonzero(~np.isfinite(array).all(1))))
            raise self.error(f"`{name}` is not finite in view {views}")
        return array.reshape(self._views, *shape)

    def names(self, name: str) -> tuple[str, ...]:
        """Return a field of text, one a view.

        Raises:
            CorruptSampleError: It is missing, or has not one entry a view.
        """
        return tuple(str(entry) for entry in self._entries(name))

    def _entries(self, name: str) -> Sequence[Any] | Array:
        if name not in self._label:
            found = ", ".join(sorted(map(str, self._label)))[:300]
            raise self.error(f"label.pyd lacks `{name}`; it has {found}")
        entries = self._label[name]
        if not isinstance(entries, list | tuple | np.ndarray) or (
            isinstance(entries, np.ndarray) and entries.ndim == 0
        ):
            raise self.error(f"`{name}` must have one entry a view; got a {type(entries).__name__}")
        if len(entries) != self._views:
            raise self.error(f"`{name}` has {len(entries)} entries for {self._views} images")
        return entries
