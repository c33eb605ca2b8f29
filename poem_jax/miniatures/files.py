"""Write the files of a miniature, and the folders that they lie in."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np


def save(path: Path, data: bytes) -> None:
    """Write bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def save_json(path: Path, value: Any) -> None:
    """Write lists, dictionaries, strings and numbers as JSON."""
    save(path, json.dumps(value).encode())


def save_npy(path: Path, value: Any) -> None:
    """Write an array, or a dictionary of arrays, as `numpy.save` does: the latter is pickled."""
    stream = io.BytesIO()
    np.save(stream, np.asarray(value), allow_pickle=True)
    save(path, stream.getvalue())


CUBE_OBJ = (
    "".join(f"v {x} {y} {z}\n" for x in (0.0, 0.05) for y in (0.0, 0.05) for z in (0.0, 0.05))
    + "f 1 2 4\nf 1 4 3\nf 5 7 8\nf 5 8 6\nf 1 5 6\nf 1 6 2\n"
    + "f 3 4 8\nf 3 8 7\nf 1 3 7\nf 1 7 5\nf 2 6 8\nf 2 8 4\n"
).encode()
"""An object of 5 cm, in place of those that people hold."""
