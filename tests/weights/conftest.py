"""Full-size models do not stay in memory when their file of tests has ended."""

import sys
from collections.abc import Iterator

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def forget_models(request: pytest.FixtureRequest) -> Iterator[None]:
    """Empty what the functions of this folder's files remember, and the compiled programs."""
    yield
    helpers = [module for name, module in sys.modules.items() if name.startswith("tests.weights.")]
    for module in (request.module, *helpers):
        for value in vars(module).values():
            if hasattr(value, "cache_clear"):
                value.cache_clear()
    jax.clear_caches()
