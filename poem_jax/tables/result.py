"""What a table comes to, whatever made it: lines with the paper's numbers and ours."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

from poem_jax.tables.places import Places


class Line(NamedTuple):
    """One line of a table."""

    group: str
    """What stands over it and its neighbours: the data set."""
    label: str
    columns: tuple[str, ...]
    paper: Mapping[str, float]
    ours: Mapping[str, float] | None = None
    """None: it did not run."""
    spread: Mapping[str, float] = {}
    """Standard errors of `ours`."""
    beside: Mapping[str, str] = {}
    """Further columns in words, such as its place among the lines of its group."""
    number: int | None = None
    samples: int | None = None
    """That were scored."""
    num_views: int | None = None
    """A point of the curve over numbers of views, of the lines with the same `series`."""
    series: str = ""
    against: str | None = None
    """Label of the line in its group that `% degrade` is told against."""
    what: Mapping[str, str] = {}
    """How it was scored: system, data, cameras, protocol, ..."""
    notes: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()
    """What is missing, and how to get it."""


class TableResult(NamedTuple):
    """A table with what could run."""

    name: str
    title: str
    lines: tuple[Line, ...]
    notes: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    """Written besides, such as submissions."""


@runtime_checkable
class AnyTable(Protocol):
    """What `poem eval --table` runs."""

    @property
    def name(self) -> str:
        """As it is asked for."""
        ...

    @property
    def title(self) -> str:
        """The paper's."""
        ...

    def run(self, places: Places, settings: "RunSettings") -> TableResult:
        """Run what can run; say of the rest what is missing."""
        ...


class RunSettings(NamedTuple):
    """How much of a table, and where files go that a row writes."""

    out: str = "out/tables"
    samples: int | None = None
    """Of each row, evenly spread; None = all."""
    batch_size: int = 8
    seed: int = 0
    progress: bool = True
