"""The allocator settings that a JAX program on a CPU wants, made before the program starts.

glibc gives big buffers back to the system and maps them anew at every call: page faults in every forward
pass. The settings that keep them are read when a process starts, so the `poem` command starts itself once
more. The library never does.
"""

import os
import platform
import sys

_VARIABLE = "GLIBC_TUNABLES"
_GUARD = "POEM_JAX_RESTARTED"
"""Set by the restart: some systems take `GLIBC_TUNABLES` out of a program's environment."""
SETTINGS = "glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold=17179869184"


def restart_with_settings() -> None:
    """Replace this process by itself with the settings, unless some are there or the system has no glibc."""
    if _VARIABLE in os.environ or os.environ.pop(_GUARD, None) or not sys.executable:
        return
    if platform.libc_ver()[0] != "glibc":
        return
    os.environ |= {_VARIABLE: SETTINGS, _GUARD: "1"}
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
