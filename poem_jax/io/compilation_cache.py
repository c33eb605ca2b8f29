"""Where compiled programs are kept between runs, so that only the first run on a machine waits for XLA."""

import os
import sys
from pathlib import Path

_VARIABLE = "JAX_COMPILATION_CACHE_DIR"


def use_compilation_cache() -> Path:
    """Turn on JAX's persistent cache; call it before the first compilation.

    Returns: the folder: `JAX_COMPILATION_CACHE_DIR` where that is set, else `poem_jax/xla` in the user's
    cache folder (`XDG_CACHE_HOME`, else `~/.cache`, on macOS `~/Library/Caches`).
    """
    import jax

    # By default programs that compile in under a second are compiled again at every start.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    if _VARIABLE in os.environ:
        return Path(os.environ[_VARIABLE])
    folder = _user_cache() / "poem_jax" / "xla"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    return folder


def _user_cache() -> Path:
    # The XDG specification counts an empty variable as unset.
    if given := os.environ.get("XDG_CACHE_HOME"):
        return Path(given)
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
