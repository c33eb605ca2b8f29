"""What was measured, in one JSON file that is rewritten after every row."""

import json
from pathlib import Path
from typing import Any

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json

Figures = dict[str, Any]
"""Of one row: what was measured, under names with units, and what identifies the row."""

FILE = "results.json"


class Results:
    """The rows of one machine, by name, and how the training that followed went."""

    def __init__(self, folder: Path) -> None:
        """Read what an earlier sitting left in the folder, or begin.

        Raises: ValueError: the file there is none of ours.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self.file = folder / FILE
        stored = read_json(self.file, what="results") if self.file.exists() else {}
        if not isinstance(stored, dict) or not isinstance(stored.get("rows", {}), dict):
            raise ValueError(f"{self.file} does not hold rows. Move it away, or choose another --out")
        self.machine: Figures | None = stored.get("machine")
        self.rows: dict[str, Figures] = stored.get("rows", {})
        self.going_on: Figures | None = stored.get("going_on")

    def use_machine(self, machine: Figures) -> None:
        """Note on which machine the rows are measured.

        Raises: ValueError: rows of another device stand here.
        """
        if self.machine is not None and self.rows and self.machine["device"] != machine["device"]:
            raise ValueError(
                f"{self.file} holds rows of {self.machine['device']}; this is {machine['device']}. "
                "Choose another --out"
            )
        self.machine = machine
        self.write()

    def is_measured(self, name: str) -> bool:
        """Tell whether a row has its figures already."""
        return name in self.rows and "problem" not in self.rows[name]

    def note(self, name: str, figures: Figures) -> None:
        """Keep a row's figures, on disk before this returns."""
        self.rows[name] = figures
        self.write()

    def write(self) -> None:
        """Write all of it."""
        content = {"machine": self.machine, "rows": self.rows, "going_on": self.going_on}
        with whole_file(self.file) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
