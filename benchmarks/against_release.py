"""How fast are we beside the authors' release? `python benchmarks/against_release.py --torch-python PYTHON`.

The release is its networks in plain PyTorch (`benchmarks/torch_release`), float32, without gradients, on all
cores: in its best form, channels-last, and in PyTorch's own layout, NCHW. Ours is
`infer(prepare(params, config), ...)`. All have the weights that are drawn from their names and the stored
inputs of the reference (`../shared`), batch 1, and begin with uint8 images. POEM v1 draws its basis points,
on either side.

Ours runs in a process of the interpreter that starts this script, the release in one of PYTHON, where torch
and NumPy are; both with the glibc settings of the `poem` command. They take turns - ours, channels-last,
NCHW - and each idles while the other works. A figure is the median of at least 7 rounds, after one that does
not count.

That both compute what the release does is shown by the distances of the query points from the stored outputs;
for these POEM v1 is given the stored basis points. Neighbours at like distances change places, which moves
single points.

Peak memory is that of a process without settings that runs one case twice; ours reads its programs from the
cache on disk.
"""

import argparse
import functools
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch_release.turns import Worker, peak_gb, serve  # beside this file

from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT
from poem_jax.io.allocator import SETTINGS

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT.parent / "shared" / "reference"
MIN_ROUNDS = 7
OURS, FORMS = "ours", ("channels-last", "NCHW")
PERCENTILES = (50, 99, 100)
CONSTANTS = ("basis_points", "anchor_points", "anchor_indices", "template")

TO_GET_TORCH = (
    "`python -m venv torchenv && torchenv/bin/pip install numpy torch --index-url "
    "https://download.pytorch.org/whl/cpu`, then --torch-python torchenv/bin/python"
)


class Case(NamedTuple):
    """A network and one sample of the stored inputs."""

    network: str
    views: int
    inputs: str
    sample: int

    @property
    def name(self) -> str:
        """Name of the case's file."""
        return f"{self.network}-{self.views}"


PRESETS = {"v2": "v2-medium-release", "v1": "v1-release-dexycb"}
CASES = (Case("v2", 8, "B", 0), Case("v2", 4, "A", 2), Case("v2", 1, "C", 0), Case("v1", 8, "b", 0))


def main() -> None:
    """Print the tables, or answer as our process where `--answer` is given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=MIN_ROUNDS, help=f"at least {MIN_ROUNDS} (default)")
    parser.add_argument("--torch-python", metavar="PYTHON", default=sys.executable, help="where torch is")
    parser.add_argument("--network", choices=PRESETS, help="without it both")
    parser.add_argument("--quick", action="store_true", help="one round, fewest views: does it run?")
    parser.add_argument("--answer", metavar="FOLDER", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.answer:
        _answer(given.answer)
        return
    if given.rounds < MIN_ROUNDS:
        parser.error(f"--rounds must be at least {MIN_ROUNDS}; got {given.rounds}")
    python = shutil.which(given.torch_python)
    if not REFERENCE.is_dir():
        print(f"the reference material is not on this machine ({REFERENCE}): nothing to compare with")
        return
    if python is None or not _has_torch(python):
        print(f"no PyTorch for {given.torch_python}: {TO_GET_TORCH}")
        return
    cases = [case for case in CASES if given.network in (None, case.network)]
    if given.quick:
        cases = list({case.network: case for case in cases}.values())
    with tempfile.TemporaryDirectory() as folder:
        _compare(folder, os.path.abspath(python), cases, 1 if given.quick else given.rounds)


def _has_torch(python: str) -> bool:
    done = subprocess.run([python, "-c", "import numpy, torch"], capture_output=True, check=False)
    return done.returncode == 0


def _compare(folder: str, python: str, cases: list[Case], rounds: int) -> None:
    start_ours = functools.partial(Worker, [sys.executable, __file__, "--answer", folder])
    start_release = functools.partial(
        Worker, [python, "-m", "torch_release.answer", folder], folder=Path(__file__).parent
    )
    with start_ours(SETTINGS) as writer:
        writer.ask("write", networks=sorted({case.network for case in cases}))
    with start_ours(SETTINGS) as ours, start_release(SETTINGS) as release:
        versions = f"{ours.ask('version')}, {release.ask('version')}"
        workers = {OURS: ours, **dict.fromkeys(FORMS, release)}
        seconds = {(case, form): [] for case in cases for form in workers}
        for number in range(-1, rounds):
            for (case, form), taken in seconds.items():
                spent = workers[form].ask("run", network=case.network, case=case.name, form=form)
                if number >= 0:
                    taken.append(spent)
        distances = {
            (case, form): workers[form].ask("distances", network=case.network, case=case.name, form=form)
            for case, form in seconds
        }
    peaks = {
        (case, form): _peak(start, case, form)
        for case in cases
        for form, start in ((OURS, start_ours), (FORMS[0], start_release))
    }
    print(f"{versions}. Seconds, medians of rounds by turns, {rounds} in all:\n")
    titles = ["model", "views", OURS, *(f"release, {f}" for f in FORMS), *(f"{f} / ours" for f in FORMS)]
    _print_table(titles, [_time_row(case, seconds) for case in cases])
    print("\nDistance of the query points from the release's stored ones, micrometres:\n")
    titles = ["model", "views", "", *(f"{q} %" for q in PERCENTILES[:-1]), "farthest"]
    _print_table(titles, [_distance_row(*key, metres) for key, metres in distances.items()])
    print("\nPeak memory of a process without allocator settings, GB:\n")
    rows = [[*_title(case), *(f"{peaks[case, form]:.2f}" for form in (OURS, FORMS[0]))] for case in cases]
    _print_table(["model", "views", OURS, f"release, {FORMS[0]}"], rows)


def _peak(start: Any, case: Case, form: str) -> float:
    with start(None) as worker:
        for _ in range(2):
            worker.ask("run", network=case.network, case=case.name, form=form)
        return worker.ask("peak")


def _time_row(case: Case, seconds: dict[tuple[Case, str], list[float]]) -> list[str]:
    ours, *release = (statistics.median(seconds[case, form]) for form in (OURS, *FORMS))
    times, ratios = [f"{s:.3f}" for s in (ours, *release)], [f"{s / ours:.2f}" for s in release]
    return [*_title(case), *times, *ratios]


def _distance_row(case: Case, form: str, metres: list[float]) -> list[str]:
    return [*_title(case), form, *(f"{1e6 * np.percentile(metres, q):.2f}" for q in PERCENTILES)]


def _title(case: Case) -> list[str]:
    return [PRESETS[case.network], str(case.views)]


def _print_table(titles: list[str], rows: list[list[str]]) -> None:
    for cells in (titles, ["---"] * len(titles), *rows):
        print("| " + " | ".join(cells) + " |")


# What follows runs in our process.


def _answer(folder: Path) -> None:
    import jax

    from poem_jax.models.infer import _cores

    jax.config.update("jax_compilation_cache_dir", str(folder / "programs"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    ours = Ours(folder)
    answers = {"run": ours.run, "distances": ours.distances, "peak": peak_gb}
    answers["version"] = lambda: f"{jax.devices()[0].device_kind}, {_cores()} cores, jax {jax.__version__}"
    answers["write"] = lambda networks: _write(folder, networks)
    serve(answers)


class Ours:
    """Our models, loaded when they are first asked for; `form` is always `OURS`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._prepared = functools.cache(self._prepare)
        self._inputs = functools.cache(self._read)

    def run(self, network: str, case: str, form: str) -> float:
        """Return the seconds of one call."""
        prepared, inputs = self._prepared(network), self._inputs(case)
        start = time.perf_counter()
        _points(prepared, inputs)
        return time.perf_counter() - start

    def distances(self, network: str, case: str, form: str) -> list[float]:
        """Return the distance of each query point from the stored one, metres."""
        inputs = self._inputs(case)
        points = _points(self._prepared(network), inputs, ball_index=inputs.get("ball_index"))
        return np.linalg.norm(points - inputs["points"], axis=-1).tolist()

    def _prepare(self, network: str) -> Any:
        from poem_jax import load, prepare, preset

        config, params = load(self._folder / f"ours-{network}", expected=preset(PRESETS[network]))
        return prepare(params, config)

    def _read(self, case: str) -> dict[str, np.ndarray]:
        with np.load(self._folder / f"{case}.npz") as arrays:
            return dict(arrays)


def _points(prepared: Any, inputs: dict[str, np.ndarray], ball_index: np.ndarray | None = None) -> np.ndarray:
    """Return the query points of the one sample (799, 3)."""
    import jax

    from poem_jax import Cameras, infer

    T = np.linalg.inv(inputs["E"].astype(np.float64))
    cams = Cameras(inputs["K"][None], T[None], np.ones((1, len(T)), bool))
    root = inputs["joints"][None, ROOT_JOINT] if len(T) == 1 else None
    found = infer(prepared, inputs["images"][None], cams, root_world=root, ball_index=ball_index)
    return np.asarray(jax.block_until_ready(found).layers_world)[0, -1]


# The weights and inputs of both sides, drawn and read as the tests do.


def _write(folder: Path, networks: list[str]) -> None:
    sys.path.insert(0, str(ROOT))
    for network in networks:
        {"v2": _write_v2, "v1": _write_v1}[network](folder)


def _write_v2(folder: Path) -> None:
    from poem_jax import save
    from tests.weights import procedural

    config, params = procedural.released("medium")
    save(folder / "ours-v2", config, params)
    _store(folder / "v2.npz", procedural.state_dict("medium"))
    constants = procedural.constants()
    constants["template"] = params["constants"]["template_queries"]
    _store(folder / "constants.npz", {name: constants[name] for name in CONSTANTS})
    for case in (case for case in CASES if case.network == "v2"):
        data, stored = procedural.inputs(case.inputs), procedural.golden(f"medium_{case.inputs}")
        end = int(data["views"][: case.sample + 1].sum())
        views = slice(end - case.views, end)
        np.savez(
            folder / f"{case.name}.npz",
            images=data["image_u8"][views],
            K=data["target_cam_intr"][views],
            E=data["target_cam_extr"][views],
            joints=data["master_joints_3d"].reshape(-1, NUM_JOINTS, 3)[case.sample],
            points=stored["all_coords_preds"][case.sample, -1],
        )


def _write_v1(folder: Path) -> None:
    from poem_jax import save
    from poem_jax.weights.torch_import import convert
    from tests.weights import v1_procedural

    state = v1_procedural.state_dict("poem")
    config, params = convert(state, "v1", mano=v1_procedural.REFERENCE_V1 / "fake_mano.npz")
    save(folder / "ours-v1", config, params)
    _store(folder / "v1.npz", state)
    for case in (case for case in CASES if case.network == "v1"):
        data, stored = v1_procedural.inputs(case.inputs), v1_procedural.golden(f"poem_{case.inputs}")
        row = slice(case.sample, case.sample + 1)
        np.savez(
            folder / f"{case.name}.npz",
            images=np.moveaxis(data["image_u8"][case.sample], 1, -1),
            K=data["target_cam_intr"][case.sample],
            E=data["target_cam_extr"][case.sample],
            joints=data["master_joints_3d"][case.sample],
            points=stored["all_coords_preds"][-1, case.sample],
            ball_index=stored["ball_index"][row],
        )


def _store(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main()
