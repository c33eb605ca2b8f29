from pathlib import Path

import jax
import pytest

from poem_jax.io.compilation_cache import use_compilation_cache


@pytest.fixture(autouse=True)
def _restore_the_setting():
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_the_users_cache_folder_is_the_default(monkeypatch, tmp_path) -> None:
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert use_compilation_cache() == tmp_path / "poem_jax" / "xla"
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "poem_jax" / "xla")


def test_an_empty_variable_counts_as_unset(monkeypatch, tmp_path) -> None:
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert use_compilation_cache().is_relative_to(tmp_path)


def test_jaxs_own_variable_comes_first(monkeypatch) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/somewhere/else")
    before = jax.config.jax_compilation_cache_dir
    assert use_compilation_cache() == Path("/somewhere/else")
    assert jax.config.jax_compilation_cache_dir == before
