import subprocess
import sys

import pytest

import poem_jax


def test_public_names_resolve():
    for name in poem_jax.__all__:
        assert getattr(poem_jax, name) is not None


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = poem_jax.nonsense


def test_importing_the_package_does_not_import_jax():
    code = "import sys, poem_jax; poem_jax.Cameras; raise SystemExit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
