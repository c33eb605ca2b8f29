"""A whole run on all six sets, from its archives to its errors by set, and what can befall it on the way."""

import json
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from orbax.checkpoint import v1 as ocp

from poem_jax.training.journal import METRICS, read_entries
from tests.training import six_sets
from tests.training.sittings import Blow, Sittings

pytestmark = [
    pytest.mark.slow,
    # Orbax, of a checkpoint that is read as it lies there.
    pytest.mark.filterwarnings("ignore:Sharding info not provided"),
]

KILLED = -9
BLOWS = 20
TORN = ".orbax-checkpoint-tmp"
"""In the name of a checkpoint while it is written."""
SOON_S = 60
"""For a worker to draw the sample at hand; it takes less than a tenth of one."""
FULL_AT = 2**18
"""Bytes of the largest file on a full disk: less than those of a checkpoint, more than all others have."""
OF_TIME = ("seconds", "per_second", "data_wait_share", "memory", "time")
"""In the names of metrics that no two runs share."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The sets, and an experiment on them."""
    folder = tmp_path_factory.mktemp("survival")
    six_sets.write_sets(folder)
    (folder / "six.py").write_text(
        "from pathlib import Path\n\nfrom tests.training.six_sets import experiment\n\n"
        f"config = experiment(Path({str(folder)!r}))\n"
    )
    return folder


@pytest.fixture(scope="module")
def sittings(folder) -> Iterator[Sittings]:
    with Sittings(folder) as sittings:
        yield sittings


@pytest.fixture(scope="module")
def unbroken(folder, sittings) -> Path:
    """The run in one sitting."""
    return finished(folder, sittings, folder / "unbroken")


def command(folder: Path, run: Path) -> list[str]:
    return [str(folder / "six.py"), "--train.out", str(run)]


def finished(folder: Path, sittings: Sittings, run: Path) -> Path:
    status, words = sittings.run(*command(folder, run))
    assert status == 0, words
    return run


def newest(run: Path) -> dict[str, np.ndarray]:
    """Read the newest checkpoint: all its arrays, by name."""
    with ocp.training.Checkpointer(str(run / "checkpoints")) as checkpoints:
        return {name: np.asarray(leaf) for name, leaf in checkpoints.load().items()}


def assert_same(run: Path, unbroken: Path) -> None:
    """Parameters, optimiser and averages are the same to the last bit."""
    found, expected = newest(run), newest(unbroken)
    assert found["step"] == six_sets.STEPS
    assert {name.split(".")[0] for name in expected} == {"step", "params", "opt_state", "ema"}
    assert found.keys() == expected.keys()
    for name, leaf in found.items():
        assert leaf.tobytes() == expected[name].tobytes(), name


def journal(run: Path) -> list[dict[str, Any]]:
    """Read the metrics, without those that tell the time."""
    return [
        {name: value for name, value in entry.items() if not any(word in name for word in OF_TIME)}
        for entry in read_entries(run / METRICS)
    ]


def blows(run: Path) -> list[Blow]:
    """Draw twenty moments: inside the write of a checkpoint, between it and its checksums, and anywhere."""
    rng = np.random.default_rng(20)
    moments = [Blow(f"{TORN}/", int(rng.integers(1, 14))) for _ in range(6)]
    moments += [Blow(f"{run}/seals/", 1) for _ in range(2)]
    moments += [Blow(f"{run}/", int(rng.integers(1, 110)), rng.exponential(0.1)) for _ in range(12)]
    return [moments[i] for i in rng.permutation(BLOWS)]


def test_a_run_that_is_killed_twenty_times_ends_as_one_that_is_not(folder, sittings, unbroken):
    run = folder / "broken"
    torn = 0
    for blow in blows(run):
        status, words = sittings.run(*command(folder, run), blow=blow)
        assert status == KILLED, words
        torn += any(TORN in path.name for path in (run / "checkpoints").glob("*"))
        assert_nobody_left(sittings)
    assert torn >= 6
    finished(folder, sittings, run)
    assert_same(run, unbroken)
    assert journal(run) == journal(unbroken)


def assert_nobody_left(sittings: Sittings) -> None:
    until = time.monotonic() + SOON_S
    while (left := sittings.left_behind()) and time.monotonic() < until:
        time.sleep(0.02)
    assert not left


def test_every_set_is_drawn_and_evaluated(unbroken):
    reports = json.loads((unbroken / "data_report.json").read_text())
    assert len(reports) == 1
    sources = reports[0]["sources"]
    assert len(sources) == len(six_sets.SHARES) + 1
    assert all(source["samples"] > 0 for source in sources.values())
    config = six_sets.experiment(unbroken.parent)
    trained = six_sets.STEPS * six_sets.BATCH
    drawn = sum(source["samples"] for source in sources.values())
    assert trained <= drawn <= trained + (config.data.prefetch + 3) * six_sets.BATCH
    corrupt = {name: source for name, source in sources.items() if source["corrupt"]}
    assert [name.lower().split()[0] for name in corrupt] == [six_sets.CORRUPT]
    (named,) = [source["corrupt_samples"] for source in corrupt.values()]
    assert [key.split("/")[-1] for key in named] == ["000000000"]

    last = journal(unbroken)[-1]
    assert (last["step"], last["group"]) == (six_sets.STEPS, "validation")
    evaluated = [
        name for name in sources if six_sets.ONE_VIEW not in name.lower() and "synthetic" not in name
    ]
    assert len(evaluated) == len(six_sets.SHARES) - 1
    for name in evaluated:
        part = re.sub(r"\W+", "_", name)
        assert 0 < last[f"mpvpe_mm_{part}"] < np.inf
    assert 0 < last["mpvpe_mm_2views"] < np.inf


def copy_of(run: Path, name: str) -> Path:
    copy = run.with_name(name)
    shutil.copytree(run, copy)
    return copy


def test_a_flipped_bit_in_the_newest_checkpoint_costs_its_steps_and_nothing_else(folder, sittings, unbroken):
    run = copy_of(unbroken, "flipped")
    arrays = max(
        (run / "checkpoints" / str(six_sets.STEPS)).rglob("d/*"), key=lambda file: file.stat().st_size
    )
    content = bytearray(arrays.read_bytes())
    content[len(content) // 2] ^= 1
    arrays.write_bytes(content)
    status, words = sittings.run(*command(folder, run))
    assert status == 0
    assert re.search(rf"poem: checkpoint {six_sets.STEPS} in .* is damaged .*its bytes have changed", words)
    assert f"resumed at step {six_sets.STEPS - 2} from" in words
    assert_same(run, unbroken)
    assert journal(run) == journal(unbroken)


def test_a_full_disk_ends_a_run_that_goes_on_when_there_is_room(folder, sittings, unbroken):
    run = copy_of(unbroken, "full")
    shutil.rmtree(run / "checkpoints" / str(six_sets.STEPS))
    (run / "seals" / f"{six_sets.STEPS}.json").unlink()
    before = newest(run)
    assert before["step"] == six_sets.STEPS - 2
    status, words = sittings.run(*command(folder, run), largest_file=FULL_AT)
    assert status == 2
    assert re.search(rf"poem: error: checkpoint {six_sets.STEPS} in .* could not be written .* MiB of", words)
    assert "Traceback" not in words
    after = newest(run)
    assert all(leaf.tobytes() == after[name].tobytes() for name, leaf in before.items())
    finished(folder, sittings, run)
    assert_same(run, unbroken)
