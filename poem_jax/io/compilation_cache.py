"""Where compiled programs are kept between runs, so that only the first run on a machine waits for XLA."""

import os
from pathlib import Path

from poem_jax.io.user_cache import user_cache_folder

_VARIABLE = "JAX_COMPILATION_CACHE_DIR"


def use_compilation_cache() -> Path:
    """Turn on JAX's persistent cache; call it before the first compilation.

    Returns: the folder: `JAX_COMPILATION_CACHE_DIR` where that is set, else `xla` in our folder of the user's
    cache (`user_cache.py`).
    """
    import jax

    # By default programs that compile in under a second are compiled again at every start.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    if _VARIABLE in os.environ:
        return Path(os.environ[_VARIABLE])
    folder = user_cache_folder() / "xla"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    return folder
