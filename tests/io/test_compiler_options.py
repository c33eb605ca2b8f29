"""Options of the compiler: they are passed on where this jaxlib has them, and left out where it has not."""

import jax
import numpy as np
import pytest

from poem_jax.io import compiler_options
from poem_jax.io.compiler_options import cpu_options


@pytest.fixture(autouse=True)
def asked_anew():
    compiler_options._is_known.cache_clear()
    yield
    compiler_options._is_known.cache_clear()


@pytest.mark.parametrize("one_thread", [True, False])
def test_programs_compile_with_them(one_thread):
    options = cpu_options(one_thread=one_thread)
    assert ("xla_cpu_multi_thread_eigen" in options) is one_thread
    assert options["xla_cpu_prefer_vector_width"] == "512"
    # With another jaxlib than the locked one this may have to go.
    assert options["xla_cpu_experimental_ynn_fusion_type"] == ""
    twice = jax.jit(lambda x: 2 * x, compiler_options=options)
    np.testing.assert_array_equal(twice(np.arange(3.0)), [0, 2, 4])


def test_one_that_a_jaxlib_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setattr(compiler_options, "_NO_YNN", ("xla_cpu_no_such_option", ""))
    options = cpu_options(one_thread=False)
    assert "xla_cpu_no_such_option" not in options
    assert "xla_cpu_prefer_vector_width" in options


def test_a_value_that_is_refused_is_no_unknown_option(monkeypatch):
    monkeypatch.setattr(compiler_options, "_WIDE", ("xla_cpu_prefer_vector_width", "wide"))
    with pytest.raises(jax.errors.JaxRuntimeError):
        cpu_options(one_thread=False)
