"""Full-size models do not stay in memory when their file of tests has ended."""

from collections.abc import Iterator

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def forget_models(request: pytest.FixtureRequest) -> Iterator[None]:
    """Empty what a file's functions remember, and the compiled programs."""
    yield
    for value in vars(request.module).values():
        if hasattr(value, "cache_clear"):
            value.cache_clear()
    jax.clear_caches()
