"""Where a program may keep what it can make again: the user's cache folder."""

import os
import sys
from pathlib import Path


def user_cache_folder() -> Path:
    """Return our folder in the user's cache; it need not exist.

    `poem_jax` in `XDG_CACHE_HOME`, else in `~/.cache`, on macOS in `~/Library/Caches`. The XDG specification
    counts an empty variable as unset.
    """
    if given := os.environ.get("XDG_CACHE_HOME"):
        return Path(given) / "poem_jax"
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "poem_jax"
