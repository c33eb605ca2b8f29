"""What `poem_jax.geometry` gives by name."""

import subprocess
import sys


def test_geometry_gives_what_it_names_and_imports_no_jax_for_it() -> None:
    import poem_jax.geometry as geometry

    assert all(callable(getattr(geometry, name)) for name in geometry.__all__)
    assert set(geometry.__all__) == set(geometry._HOME)
    code = "import sys, poem_jax.geometry; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
