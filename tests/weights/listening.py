"""An ear on what the parts of a model return while it is traced."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest

Heard = dict[str, list[Any]]
"""By name, what was kept of every call, in the order of the calls."""
Ears = Mapping[str, tuple[Any, str, Callable[[tuple, Any], Any]]]
"""By name: the owner and the attribute of a function or method, and what is kept of its arguments and
result."""


@contextmanager
def listening(ears: Ears) -> Iterator[Heard]:
    """Keep, within the block, what the functions return."""
    heard: Heard = defaultdict(list)

    def with_ear(name: str, function: Callable, pick: Callable) -> Callable:
        def call(*args: Any, **options: Any) -> Any:
            out = function(*args, **options)
            heard[name].append(pick(args, out))
            return out

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name, (owner, attribute, pick) in ears.items():
            patch.setattr(owner, attribute, with_ear(name, getattr(owner, attribute), pick))
        yield heard
