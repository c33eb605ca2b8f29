"""What is said when a checkpoint cannot be written or read: one error each, whatever Orbax calls it."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from poem_jax.training.hosts import HostLost, any_host, names_lost_host


class CheckpointNotWritten(OSError):
    """A checkpoint could not be written; those before it are as they were."""


class CheckpointDamaged(ValueError):
    """The files of a checkpoint are not those that were written."""


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
        raise CheckpointNotWritten(
            f"checkpoint {step} in {folder} could not be written ({type(error).__name__}: "
            f"{str(error)[:300]}; {_free_in(folder)}). Those before it are as they "
            "were: make room, and the same command goes on from there"
        ) from error


def _free_in(folder: Path) -> str:
    try:
        usage = shutil.disk_usage(folder)
    except OSError as error:
        return f"what is free there cannot be told: {error}"
    return f"{usage.free / 2**20:.0f} MiB of {usage.total / 2**20:.0f} are free there"


@contextlib.contextmanager
def names_damage(step: int, folder: Path) -> Iterator[None]:
    """While checksums are compared: a `ValueError` is damage, whatever else a fault that proves none; on all
    hosts if on one.

    Raises:
        CheckpointDamaged: files differ from their checksums.
        ValueError: that cannot be told.
    """
    problem = None
    try:
        yield
    except (ValueError, OSError) as error:
        problem = error
    if any_host(isinstance(problem, ValueError)):
        raise CheckpointDamaged(f"checkpoint {step} in {folder} is damaged ({_said(problem)})") from problem
    if any_host(problem is not None):
        raise ValueError(
            f"checkpoint {step} in {folder} cannot be compared with its checksums ({_said(problem)}). "
            "Nothing has been moved: mend that, and the same command goes on from there"
        ) from problem


@contextlib.contextmanager
def names_unreadable(step: int, folder: Path, *, checked: bool) -> Iterator[None]:
    """Turn whatever a reader says into one error, on all hosts if it was said on one.

    Raises:
        CheckpointDamaged: the checkpoint has not been `checked` against checksums.
        ValueError: it has, so that the reason is another.
    """
    problem: Exception | None = None
    try:
        yield
    except Exception as error:
        # Orbax and TensorStore raise many kinds; each means that the arrays cannot be read.
        problem = error
    if not any_host(problem is not None):
        return
    if not checked:
        raise CheckpointDamaged(
            f"checkpoint {step} in {folder} is damaged or belongs to another model ({_said(problem)})"
        ) from problem
    raise ValueError(
        f"checkpoint {step} in {folder} has the files that were written, but cannot be read here "
        f"({_said(problem)}): it belongs to another model, or memory or the disk fails. Nothing has been "
        "moved"
    ) from problem


def _said(problem: Exception | None) -> str:
    return f"{type(problem).__name__}: {str(problem)[:300]}" if problem else "so says another host"
