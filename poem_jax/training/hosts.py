"""Several hosts that train one model: how they find each other, agree, and end when one of them is lost.

All of it is `jax.distributed`. Where there is one process, nothing here waits or talks to anybody.
"""

import atexit
import hashlib
import logging
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
from jax.experimental import multihost_utils

HEARTBEAT_TIMEOUT_S = 30
"""A host that has not been heard of for so long counts as lost, and ends the others."""
START_TIMEOUT_S = 300
"""How long hosts wait for each other at the start."""
END_TIMEOUT_S = 20
"""How long a host that ends waits for the others to end too."""

_NETWORK_DISK_S = 10
_LOST_STATUS = 2
_lost: list[str] = []
"""What was said when another host was lost."""
_log = logging.getLogger(__name__)


class HostLost(ConnectionError):
    """Another host of the run has ended, so that this one cannot go on."""


def _end_without_the_lost() -> None:
    """End now, where JAX would wait for the lost host and then abort with pages of its own."""
    if _lost:
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_LOST_STATUS)


def start_hosts(coordinator: str | None, count: int | None, index: int | None) -> None:
    """Make this process one of several that train together; call it before JAX is used.

    Args:
        coordinator: `HOST:PORT` of the first host, the same on all of them.
        count: how many processes there are.
        index: which one this is, from 0. With all three None, JAX asks SLURM, Open MPI or the TPU pod.

    Raises:
        ValueError: some of the three are given and some are not, they make no sense, or nothing is given and
            JAX finds no launcher.
        ConnectionError: the hosts have not found each other.
        RuntimeError: JAX has been used before.
    """
    given = {"--coordinator": coordinator, "--num-hosts": count, "--host-index": index}
    missing = [name for name, value in given.items() if value is None]
    if missing and len(missing) < len(given):
        raise ValueError(f"several hosts need all of {', '.join(given)}; {', '.join(missing)} is missing")
    if coordinator is not None and count is not None and index is not None:
        _check(coordinator, count, index)
    try:
        jax.distributed.initialize(
            coordinator,
            count,
            index,
            initialization_timeout=START_TIMEOUT_S,
            heartbeat_timeout_seconds=HEARTBEAT_TIMEOUT_S,
            shutdown_timeout_seconds=END_TIMEOUT_S,
        )
    except ValueError as error:
        raise ValueError(
            f"JAX finds no hosts by itself here ({error}): it asks SLURM, Open MPI and TPU pods. Start the "
            "processes with one of these, or name them: --coordinator HOST:PORT --num-hosts N --host-index I"
        ) from error
    except jax.errors.JaxRuntimeError as error:
        if coordinator is None:
            raise ConnectionError(
                f"this host has not found the others that its launcher names: {_first_line(error)}. All of "
                "them must start within 5 minutes, with open ports among them"
            ) from error
        raise ConnectionError(
            f"host {index} of {count} has not found the others at {coordinator}: {_first_line(error)}. Start "
            "all of them within 5 minutes, each with its own --host-index; the port must be free on the "
            "first host, and open to the others"
        ) from error
    # Called before what JAX has registered, which waits for the other hosts.
    atexit.register(_end_without_the_lost)


def _check(coordinator: str, count: int, index: int) -> None:
    name, _, port = coordinator.rpartition(":")
    if not name or not port.isdigit():
        raise ValueError(f"--coordinator must be HOST:PORT, as in 10.0.0.1:12345; got {coordinator!r}")
    if not 0 <= index < count:
        raise ValueError(f"--host-index must be one of 0 to --num-hosts - 1; got {index} of {count}")


def is_first_host() -> bool:
    """Say whether this process writes what is written once: the journal, pictures, reports."""
    return jax.process_index() == 0


def any_host(flag: bool) -> bool:
    """Say whether `flag` is true on any host. All hosts must ask at the same place, and wait for each other.

    Raises:
        HostLost: another host has ended.
    """
    if jax.process_count() == 1:
        return flag
    with names_lost_host():
        return bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def wait_for_all(name: str) -> None:
    """Wait until every host has come to the place with this name.

    Raises:
        HostLost: another host has ended.
    """
    if jax.process_count() == 1:
        return
    with names_lost_host():
        multihost_utils.sync_global_devices(name)


def as_on_first_host(numbers: Sequence[int]) -> list[int]:
    """Return the first host's numbers on all of them: what a disk holds may show on each at another time.

    Raises:
        HostLost: another host has ended.
    """
    if jax.process_count() == 1:
        return list(numbers)
    with names_lost_host():
        count = int(multihost_utils.broadcast_one_to_all(np.int32(len(numbers))))
        own = numbers if is_first_host() else [0] * count
        return [int(number) for number in multihost_utils.broadcast_one_to_all(np.asarray(own, np.int32))]


def count_where(place: str) -> int:
    """Return how many hosts name the same `place`, a machine, say, this one among them.

    Raises:
        HostLost: another host has ended.
    """
    if jax.process_count() == 1:
        return 1
    return sum(np.array_equal(digest, _digest(place)) for digest in _gather(place))


def check_same_everywhere(what: str, text: str) -> None:
    """Insist that all hosts have the same `text`, their config, say.

    Raises:
        ValueError: on all of them, if one has another; names `what` and which hosts.
        HostLost: another host has ended.
    """
    if jax.process_count() == 1:
        return
    of_hosts = _gather(text)
    others = [host for host, digest in enumerate(of_hosts) if not np.array_equal(digest, of_hosts[0])]
    if others:
        raise ValueError(
            f"all hosts must have the same {what}; hosts {others} have another than the first one"
        )


def _gather(text: str) -> np.ndarray:
    """Return the digests of all hosts' texts."""
    with names_lost_host():
        return multihost_utils.process_allgather(_digest(text))


def _digest(text: str) -> np.ndarray:
    return np.frombuffer(hashlib.sha256(text.encode()).digest(), np.uint8)


def check_shared_folder(folder: Path, option: str) -> None:
    """Insist that this folder is one and the same on all hosts, and leave nothing in it.

    Raises:
        ValueError: on all hosts, if one does not see what the first one writes; names the `option`.
        HostLost: another host has ended.
    """
    if jax.process_count() == 1:
        return
    file = folder / ".seen_by_all_hosts"
    if is_first_host():
        file.touch()
    wait_for_all("the first host has written")
    lonely = any_host(not _appears(file))
    if is_first_host():
        file.unlink(missing_ok=True)
    if lonely:
        raise ValueError(
            f"all hosts write to one folder, but {folder} is not the same on all of them; give {option} a "
            "folder on a disk that they share"
        )


def _appears(file: Path) -> bool:
    """Look for a file that another host has just written: network disks take seconds to show it."""
    end = time.monotonic() + _NETWORK_DISK_S
    while file.name not in os.listdir(file.parent):
        if time.monotonic() > end:
            return False
        time.sleep(0.2)
    return True


@contextmanager
def names_lost_host() -> Iterator[None]:
    """Turn what the collectives say when a host has gone into a `HostLost`; other errors stay as they are."""
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        # A ValueError where it shows when an array is fetched.
        if jax.process_count() == 1 or not _LOST.search(str(error)):
            raise
        message = (
            f"host {jax.process_index()} of {jax.process_count()} cannot go on: another host has ended or "
            f"cannot be reached ({_first_line(error)}). Its own output says why; start all hosts again, and "
            "training goes on from the newest checkpoint"
        )
        # Now, since JAX may end this process while it still waits for a write that the other takes part in.
        _log.error("%s", message)
        _lost.append(message)
        raise HostLost(message) from error


_LOST = re.compile(
    r"Gloo|heartbeat|Barrier timed out|[Cc]oordination ?[Ss]ervice|Connection (reset|closed) by peer"
    r"|remote process exited|ncclRemoteError|failed to connect to all addresses"
)
"""Words in the errors of collectives whose other side is gone, and of nothing that fails on one host alone:
NCCL also says that its own memory is full, and storage that it is unavailable."""


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:300]
