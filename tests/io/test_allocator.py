import os
import subprocess
import sys

import pytest

from poem_jax.io import allocator

PROGRAM = """
import os, sys
from poem_jax.io.allocator import restart_with_settings
restart_with_settings()
print(os.environ.get("GLIBC_TUNABLES"), sys.argv[1:])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc is on Linux")
@pytest.mark.parametrize(("given", "expected"), [(None, allocator.SETTINGS), ("x.y=1", "x.y=1")])
def test_a_program_starts_itself_once_with_the_settings(given, expected):
    environment = {k: v for k, v in os.environ.items() if k != "GLIBC_TUNABLES"}
    if given is not None:
        environment["GLIBC_TUNABLES"] = given
    command = [sys.executable, "-c", PROGRAM, "a", "--b c"]
    printed = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
    assert printed == f"{expected} ['a', '--b c']\n"


def test_a_lost_setting_is_not_asked_for_again(monkeypatch):
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    monkeypatch.setenv("POEM_JAX_RESTARTED", "1")
    monkeypatch.setattr(allocator.os, "execv", lambda *_: pytest.fail("must not restart"))
    allocator.restart_with_settings()


def test_systems_without_glibc_go_on(monkeypatch):
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    monkeypatch.setattr(allocator.platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(allocator.os, "execv", lambda *_: pytest.fail("must not restart"))
    allocator.restart_with_settings()
    assert "GLIBC_TUNABLES" not in os.environ
