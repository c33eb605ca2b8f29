import subprocess
import sys

import pytest

import poem_jax


def test_public_names_resolve():
    for name in poem_jax.__all__:
        assert getattr(poem_jax, name) is not None


@pytest.mark.parametrize(
    "room", ["calibration", "evaluation", "experiments", "fitting", "geometry", "hand", "models", "synthetic"]
)
def test_rooms_are_reachable_without_an_import_of_their_own(room):
    code = f"import poem_jax; print(poem_jax.{room}.__name__)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == f"poem_jax.{room}"


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = poem_jax.nonsense


def test_importing_the_package_does_not_import_jax():
    code = "import sys, poem_jax; poem_jax.Cameras; raise SystemExit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
