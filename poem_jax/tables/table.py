"""A table of the paper: a name, its rows, and how to run them."""

from dataclasses import dataclass

from poem_jax.tables.places import Places
from poem_jax.tables.result import RunSettings, TableResult
from poem_jax.tables.row import Row


@dataclass(frozen=True)
class Table:
    """Rows in the paper's order; an `AnyTable`."""

    name: str
    title: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def run(self, places: Places, settings: RunSettings) -> TableResult:
        """Run the rows whose data and weights are here; say of the others what is missing."""
        from poem_jax.tables.run import run_rows

        lines, files = run_rows(self.name, self.rows, places, settings)
        return TableResult(self.name, self.title, lines, self.notes, files)
