"""Miniatures, written once a session, when a test first asks for them."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from poem_jax.miniatures.mano_stand_in import write_mano
from poem_jax.miniatures.names import WRITERS
from poem_jax.miniatures.scene import PlantedFrame

FRAMES = {"interhand": 2}
"""More than one, where the second is unlike the first."""


class Written(NamedTuple):
    root: Path
    planted: list[PlantedFrame]


@pytest.fixture(scope="session")
def miniature(tmp_path_factory) -> Callable[[str], Written]:
    @cache
    def write(name: str) -> Written:
        root = tmp_path_factory.mktemp(name)
        count = FRAMES.get(name, 1)
        few = {"samples": count} if name.startswith("tars-") else {"frames": count}
        return Written(root, WRITERS[name](root, **few))

    return write


@pytest.fixture(scope="session")
def mano_file(tmp_path_factory) -> Path:
    return write_mano(tmp_path_factory.mktemp("mano") / "MANO_RIGHT.pkl")
