"""Settings that hold for the whole suite."""

import gc
import importlib.util
import os
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

# Two host devices let the tests of data-parallel training run on a CPU; JAX reads this when it starts. Most
# of the suite is compiling, so LLVM optimises nothing, and gets XLA's older and shorter code of fusions: a
# training step compiles in a quarter of the time. XLA ends with an error where it no longer knows a flag.
# `make test-parity` compiles as users do.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0 "
    "--xla_llvm_disable_expensive_passes=true --xla_cpu_use_fusion_emitters=false",
)
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Devices that wait for each other hold a thread each of the shared pool, two more do the work. Many more
# would fight for the cores: with 32, a fit of 64 frames takes three seconds instead of a fifth of one.
os.environ.setdefault("PJRT_NPROC", "4")

import pytest

_CACHE = "JAX_COMPILATION_CACHE_DIR"
_own_cache: str | None = None
if _CACHE not in os.environ and importlib.util.find_spec("filelock"):
    # What compiles in more than 0.2 s is compiled once a run, whichever worker or command needs it first.
    # A limit of the size makes JAX lock the folder, so that nobody reads a program half written.
    _own_cache = os.environ[_CACHE] = tempfile.mkdtemp(prefix="poem-tests-xla-")
    os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(2**33)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"


def pytest_configure() -> None:
    """Keep JAX from measuring the folder, which never gets full, before it adds a program: with 1,600 in it
    that takes a fifth of a second. And look for garbage less often: a million objects live as long as the
    suite, and going through them took 8 % of its time."""
    from jax._src.lru_cache import LRUCache

    LRUCache._evict_if_needed = lambda cache, **_: None
    gc.set_threshold(5_000, 10, 20)


def pytest_unconfigure() -> None:
    """Remove the compiled programs; workers found the folder made, and leave it."""
    if _own_cache is not None:
        shutil.rmtree(_own_cache, ignore_errors=True)


_LONGEST = (
    "test_survival.py",
    "test_release_parity.py",
    "test_release_training.py",
    "test_plain_form.py",
    "test_v1_poem_parity.py",
    "test_v1_import.py",
    "test_every_preset_learns.py",
    "test_hosts.py",
    "test_shipped_model.py",
    "test_wheel.py",
    "test_accelerator.py",
)
"""Minutes each."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that no worker is left alone with one."""
    places = {name: place for place, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: places.get(item.path.name, len(places)))


_END = float(os.environ.get("POEM_TESTS_END", "inf"))
"""When no test may begin any more (seconds since 1970): what is run within a limit of time sets it."""
_TOO_LATE = "the time given to the tests is over (POEM_TESTS_END)"
_MAX_TOO_LATE = 12
"""A run that leaves out more has not tested enough, and fails."""
_too_late: list[str] = []


def pytest_runtest_setup() -> None:
    """Skip what would begin too late; in the report it is told apart from what has passed."""
    if time.time() > _END:
        pytest.skip(_TOO_LATE)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.skipped and _TOO_LATE in str(report.longrepr):
        _too_late.append(report.nodeid)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    if len(_too_late) > _MAX_TOO_LATE and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if _too_late:
        terminalreporter.write_line(f"{len(_too_late)} begun too late and not run (at most {_MAX_TOO_LATE})")


SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of reference material beside the checkout; tests that need it skip where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("reference material (../shared) is not on this machine")
    return SHARED


@pytest.fixture(scope="session")
def micro_model():
    """Config and parameters of a model that compiles in seconds and has learned nothing."""
    import jax

    from poem_jax.models.apply import init
    from tests.micro import MICRO

    four_stages = replace(MICRO.backbone, blocks=(1, 1, 1, 1), channels=(8, 8, 8, 8))
    config = replace(MICRO, image_hw=(64, 64), backbone=four_stages)
    return config, init(config, key=jax.random.key(0))
