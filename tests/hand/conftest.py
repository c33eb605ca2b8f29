import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from poem_jax.hand.model import HandModel
from poem_jax.hand.template import default_hand

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(params=[(), (1,), (3, 1, 2)])
def batch(request) -> tuple[int, ...]:
    return request.param


@pytest.fixture
def hand() -> HandModel:
    """The shipped right hand in float64, its rows summing to 1 in that precision too."""
    model = HandModel(*(a.astype(np.float64) if a.dtype.kind == "f" else a for a in default_hand()))
    return model._replace(
        weights=model.weights / model.weights.sum(axis=1, keepdims=True),
        J_regressor=model.J_regressor / model.J_regressor.sum(axis=1, keepdims=True),
    )


@pytest.fixture(scope="session")
def measures() -> ModuleType:
    """What `tools/measure_hand.py` measures with."""
    sys.path.insert(0, str(TOOLS))
    try:
        return importlib.import_module("hand_design.measures")
    finally:
        sys.path.remove(str(TOOLS))
