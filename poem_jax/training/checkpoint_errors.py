"""What is said when a checkpoint cannot be written or read: one error each, whatever Orbax calls it."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from poem_jax.training.hosts import HostLost, any_host, names_lost_host


class CheckpointNotWritten(OSError):
    """A checkpoint could not be written; those before it are as they were."""


@contextlib.contextmanager
def names_failed_write(step: int | None, folder: Path) -> Iterator[None]:
    """Turn whatever a writer says into a `CheckpointNotWritten` that says what is left."""
    try:
        with names_lost_host():
            yield
    except HostLost:
        raise
    except Exception as error:
        # Orbax and TensorStore raise many kinds, some for the same full disk.
        usage = shutil.disk_usage(folder)
        free = f"{usage.free / 2**20:.0f} MiB of {usage.total / 2**20:.0f} are free there"
        raise CheckpointNotWritten(
            f"checkpoint {step} in {folder} could not be written ({type(error).__name__}: "
            f"{str(error)[:300]}; {free}). Those before it are as they were: make room, and the same command "
            "goes on from there"
        ) from error


@contextlib.contextmanager
def names_damage(step: int, folder: Path) -> Iterator[None]:
    """Turn whatever a reader says into a `ValueError`, on all hosts if it was said on one."""
    problem: Exception | None = None
    try:
        yield
    except Exception as error:
        # Orbax and TensorStore raise many kinds; each means that the arrays cannot be read.
        problem = error
    if any_host(problem is not None):
        found = f"{type(problem).__name__}: {str(problem)[:300]}" if problem else "so says another host"
        raise ValueError(
            f"checkpoint {step} in {folder} is damaged or belongs to another model ({found})"
        ) from problem
