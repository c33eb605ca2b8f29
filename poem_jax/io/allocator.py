"""The allocator settings that a JAX program on a CPU wants, made before the program starts.

glibc gives big buffers back to the system and maps them anew at every call: page faults in every forward
pass. The settings that keep them are read when a process starts, so the `poem` command starts itself once
more. The library never does.
"""

import os
import platform
import sys

_VARIABLE = "GLIBC_TUNABLES"
SETTINGS = "glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold=17179869184"


def restart_with_settings() -> None:
    """Replace this process by itself with the settings, unless some are there or the system has no glibc."""
    if _VARIABLE in os.environ or platform.libc_ver()[0] != "glibc":
        return
    os.environ[_VARIABLE] = SETTINGS
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
