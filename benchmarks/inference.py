"""How fast and how large is inference? `python benchmarks/inference.py [--rounds N] [--preset NAME ...]`.

Every number stands beside that of the plain form (`benchmarks/plain_form.py`): the same network and weights,
in JAX as one first writes it. Both run in one process by turns - plain, optimised, plain, optimised - with
the same threads and the same allocator; a figure is the median of at least 7 rounds.

Optimised = `infer(prepare(params, config), ...)` for the whole, and its parts as it runs them: on a CPU the
trunk and the 2D branches view by view, one thread a core. Plain = `jax.jit(plain_forward)`, all cores in
every operation. In a mixed batch the plain form, which knows no masks, takes sample after sample, each with
its own number of views: the least work that it can do.

The `poem` command starts with glibc settings that keep freed memory (`poem_jax/io/allocator.py`); the library
leaves the allocator alone. So every case is measured with and without them, the parts with them alone.

Compile time is that of the first call less a later one: with an empty cache, and with the programs in JAX's
cache on disk. Peak memory is that of a process that runs one form of one case, its programs from the cache.
Weights are random, drawn by NumPy: they cost the same, and make no peak of their own.
"""

import argparse
import functools
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

from poem_jax.io.allocator import SETTINGS

PRESETS: tuple[str, ...] = ("v2-base", "v2-medium-release")
VIEWS: tuple[int, ...] = (8, 4, 1)
MIXED: tuple[int, ...] = (8, 5, 3, 1)
TINY = ("tiny", (4,))
MIN_ROUNDS = 7
PARTS = ("trunk", "2D branches", "sampling, aggregation", "decoder")
FORMS = ("plain", "optimised")
PRODUCT_SIZE = 2048
BATCHES = (1, 4, 16, 64)


def main() -> None:
    """Print the tables, or run one job where `--job` is given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=MIN_ROUNDS, help=f"at least {MIN_ROUNDS} (default)")
    parser.add_argument("--preset", action="append", help="repeatable; without it both families and tiny")
    parser.add_argument("--views", type=int, action="append", help="repeatable; without it 8, 4, 1 and mixed")
    parser.add_argument("--quick", action="store_true", help="one round, one view: does it run? no figures")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.job:
        job = json.loads(given.job)
        print(json.dumps(JOBS[job.pop("name")](**job)))
        return
    if given.rounds < MIN_ROUNDS:
        parser.error(f"--rounds must be at least {MIN_ROUNDS}; got {given.rounds}")
    rounds = 1 if given.quick else given.rounds
    views = [1] if given.quick else given.views or list(VIEWS)
    mixed = list(MIXED) if not (given.quick or given.views) else []
    cases = [(name, views, mixed) for name in given.preset or PRESETS]
    if not (given.preset or given.views):
        cases.append((TINY[0], list(TINY[1]), []))
    machine = _in_a_process("machine", SETTINGS)
    print(
        f"{machine['device']}, {machine['cores']} cores; a float32 matrix product of {PRODUCT_SIZE} x ",
        end="",
    )
    print(f"{PRODUCT_SIZE} runs at {machine['gflops']:.0f} GFLOP/s. Medians of {rounds} rounds.", flush=True)
    for name, counts, batch in cases:
        _print_preset(name, counts, batch, rounds)
    if machine["backend"] == "gpu":
        _print_gpu()


def _print_preset(name: str, views: list[int], mixed: list[int], rounds: int) -> None:
    with tempfile.TemporaryDirectory() as cache:
        job = {"preset": name, "views": views, "mixed": mixed, "rounds": rounds, "cache": cache}
        times = _in_a_process("times", SETTINGS, parts=True, **job)
        without = _in_a_process("times", None, parts=False, **job)
        cases = [[count] for count in views] + ([mixed] if mixed else [])
        alone = []
        for case in cases:
            run = {"preset": name, "case": case, "cache": cache}
            forms = FORMS if len(case) == 1 else ("optimised",)
            alone.append({form: _in_a_process("alone", SETTINGS, form=form, **run) for form in forms})
    print(f"\n### {name}\n\nSeconds, with the allocator settings of the `poem` command:\n")
    _print_table(["views", "", *PARTS, "whole", "whole, without settings"], _time_rows(cases, times, without))
    print("\nCompile time and memory:\n")
    titles = ["views", "", "compile s, cold", "compile s, cached", "peak GB", "peak RSS over the start GB"]
    _print_table(titles, _compile_rows(cases, times, alone))
    if mixed:
        own = sum(_median(times["whole"][_key([count])]["optimised"]) for count in mixed)
        together = _median(times["whole"][_key(mixed)]["optimised"])
        print(
            f"\nMixed batch {mixed}: {together:.2f} s, the samples one by one at their own number of views ",
            end="",
        )
        print(f"{own:.2f} s, ratio {together / own:.3f}")
    sys.stdout.flush()


def _time_rows(cases: list[list[int]], times: dict, without: dict) -> list[list[str]]:
    rows = []
    for case in cases:
        columns = [times["parts"].get(_key(case), {}).get(part) for part in PARTS]
        columns += [run["whole"][_key(case)] for run in (times, without)]
        forms = FORMS if len(case) == 1 else ("optimised",)
        for form in forms:
            cells = ["-" if c is None else f"{_median(c[form]):.3f}" for c in columns]
            rows.append([_title(case), form, *cells])
        if forms == FORMS:
            ratios = [
                "-" if c is None else f"{_median(c['optimised']) / _median(c['plain']):.2f}" for c in columns
            ]
            rows.append([_title(case), "optimised / plain", *ratios])
    return rows


def _compile_rows(cases: list[list[int]], times: dict, alone: list[dict]) -> list[list[str]]:
    rows = []
    for case, processes in zip(cases, alone, strict=True):
        for form, run in processes.items():
            cold = (
                f"{max(times['first'][_key(case)][form] - _median(times['whole'][_key(case)][form]), 0):.1f}"
            )
            cached = f"{max(run['first'] - run['later'], 0):.1f}"
            rows.append(
                [_title(case), form, cold, cached, f"{run['peak']:.2f}", f"{run['peak'] - run['start']:.2f}"]
            )
    return rows


def _print_table(titles: list[str], rows: list[list[str]]) -> None:
    for cells in (titles, ["---"] * len(titles), *rows):
        print("| " + " | ".join(cells) + " |")


def _title(case: list[int]) -> str:
    return str(case[0]) if len(case) == 1 else f"{case}"


def _key(case: list[int]) -> str:
    return ",".join(map(str, case))


def _median(seconds: list[float]) -> float:
    return statistics.median(seconds)


def _in_a_process(name: str, settings: str | None, **arguments: Any) -> dict:
    environment = {key: value for key, value in os.environ.items() if key != "GLIBC_TUNABLES"}
    if settings is not None:
        environment["GLIBC_TUNABLES"] = settings
    command = [sys.executable, __file__, "--job", json.dumps({"name": name, **arguments})]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE)
    return json.loads(done.stdout.splitlines()[-1])


# What follows runs in a process of its own.


def measure_machine() -> dict:
    """Return the device, and how fast it multiplies float32 matrices."""
    import jax

    from poem_jax.models.infer import _cores

    a = jax.random.normal(jax.random.key(0), (PRODUCT_SIZE, PRODUCT_SIZE))
    product = jax.jit(lambda x: jax.numpy.matmul(x, x, precision="highest"))
    _seconds(lambda: product(a))
    best = min(_seconds(lambda: product(a)) for _ in range(15))
    device = jax.devices()[0].device_kind
    rate = 2 * PRODUCT_SIZE**3 / best / 1e9
    return {"backend": jax.default_backend(), "device": device, "cores": _cores(), "gflops": rate}


def measure_times(
    preset: str, views: list[int], mixed: list[int], rounds: int, cache: str, parts: bool
) -> dict:
    """Return seconds of both forms by turns: `whole` and `parts` of every case, and the `first` calls."""
    config, params = _model(preset)
    cases: list[tuple[list[int], tuple[str, ...]]] = [([count], FORMS) for count in views]
    if mixed:
        others = [[count] for count in mixed if count not in views]
        cases += [(case, ("optimised",)) for case in (*others, mixed)]
    calls: dict[str, dict[str, Callable]] = {}
    first: dict[str, dict[str, float]] = {}
    for case, forms in cases:
        _keep_programs(cache, case)
        made = calls[_key(case)] = _whole_calls(params, config, case, forms)
        first[_key(case)] = {form: _first_seconds(call) for form, call in made.items()}
    whole: dict[str, dict[str, list]] = {key: {form: [] for form in forms} for key, forms in calls.items()}
    by_part = {_key([c]): _part_calls(params, config, c) for c in views} if parts else {}
    split = {key: {part: {form: [] for form in FORMS} for part in PARTS} for key in by_part}
    for round_number in range(-1, rounds):
        for key, forms in calls.items():
            _run_by_turns(forms, whole[key], keep=round_number >= 0)
        for key, named in by_part.items():
            for part, forms in named.items():
                _run_by_turns(forms, split[key][part], keep=round_number >= 0)
    return {"whole": whole, "parts": split, "first": first}


def _run_by_turns(calls: dict[str, Callable], seconds: dict[str, list], *, keep: bool) -> None:
    for form, call in calls.items():
        taken = _seconds(call)
        if keep:
            seconds[form].append(taken)


def measure_alone(preset: str, case: list[int], form: str, cache: str) -> dict:
    """Return seconds of a first call and a later one, and the memory, of one form in this process alone."""
    _keep_programs(cache, case)
    config, params = _model(preset)
    start = _peak_gb()
    call = _whole_calls(params, config, case, (form,))[form]
    first, later = _seconds(call), _seconds(call)
    return {"first": first, "later": later, "start": start, "peak": _peak_gb()}


def measure_gpu(preset: str, half: bool) -> dict:
    """Return milliseconds a frame at batch 1 and frames a second at the best batch, 8 views each."""
    import jax

    from poem_jax.models.infer import infer, prepare

    config, params = _model(preset)
    if half:
        params = _with_half_trunk(params)
    prepared, views, best = prepare(params, config), VIEWS[0], (0.0, 0)
    first_ms = 0.0
    for batch in BATCHES:
        images, cams, root = _scene(config, [views] * batch)
        images = jax.device_put(images)
        call = lambda i=images, c=cams, r=root: infer(prepared, i, c, root_world=r)  # noqa: E731
        _seconds(call)
        taken = statistics.median(_seconds(call) for _ in range(MIN_ROUNDS))
        first_ms = 1000 * taken if batch == 1 else first_ms
        best = max(best, (batch / taken, batch))
    return {"ms": first_ms, "rate": best[0], "batch": best[1]}


JOBS = {"machine": measure_machine, "times": measure_times, "alone": measure_alone, "gpu": measure_gpu}


def _whole_calls(params, config, case: list[int], forms: tuple[str, ...]) -> dict[str, Callable]:
    """Return calls of the wanted forms on one batch; `case` = views per sample."""
    import jax

    from poem_jax.models.infer import infer, prepare

    images, cams, root = _scene(config, case)
    calls: dict[str, Callable] = {}
    if "plain" in forms:
        run = _plain_program("plain_forward", config)
        held = jax.device_put(params)
        calls["plain"] = lambda: run(held, images, cams, root=root)
    if "optimised" in forms:
        prepared = prepare(params, config)
        calls["optimised"] = lambda: infer(prepared, images, cams, root_world=root)
    return calls


def _part_calls(params, config, views: int) -> dict[str, dict[str, Callable]]:
    """Return calls of every part of both forms, on what the parts before it give."""
    import jax
    import jax.numpy as jnp

    from poem_jax.models import infer as inference
    from poem_jax.models.world_frame import enter_working_frame

    on_cpu = jax.default_backend() == "cpu"
    images, cams, root = _scene(config, [views])
    frame = jax.tree.map(jnp.asarray, enter_working_frame(images, cams, root, "float32"))
    prepared, held = inference.prepare(params, config), jax.device_put(params)
    plain = {
        name: _plain_program(f"plain_{name}", config)
        for name in ("trunk", "heat_maps", "features", "sampling_and_aggregation", "decoder")
    }
    chunk = 1 if on_cpu else views
    normal = (images[0].astype("float32") / 255 - config.image_mean) / config.image_std

    levels = plain["trunk"](held, normal)
    by_view = [jax.tree.map(lambda x, i=i: x[i : i + chunk], levels) for i in range(0, views, chunk)]
    maps = plain["features"](held, levels)[None]
    tokens = plain["sampling_and_aggregation"](held, maps, frame.cams, frame.known_root)
    start = params["constants"]["template_queries"][None] / config.basis.radius
    inputs = (maps, frame.cams, frame.known_root)
    plain_calls = (
        lambda: plain["trunk"](held, normal),
        lambda: (plain["heat_maps"](held, levels), plain["features"](held, levels)),
        lambda: plain["sampling_and_aggregation"](held, *inputs),
        lambda: plain["decoder"](held, start, tokens)[:2],
    )
    everything = [images[0, i : i + chunk] for i in range(0, views, chunk)]
    parts = ((_trunk, everything), (_branches, by_view), (_read, [inputs]), (_decode, [(start, tokens)]))
    optimised_calls = [
        functools.partial(inference._run_all, _jitted(part), prepared, given) for part, given in parts
    ]
    both = zip(PARTS, plain_calls, optimised_calls, strict=True)
    return {part: dict(zip(FORMS, calls, strict=True)) for part, *calls in both}


@functools.cache
def _jitted(part: Callable) -> Callable:
    import jax

    return jax.jit(part)


def _trunk(prepared, images):
    from poem_jax.models.layers import trunk_images

    model = _module(prepared)
    return model.trunk(trunk_images(images, model.config, model.basis_points[...].dtype), _mode())


def _branches(prepared, levels):
    model, levels = _module(prepared), tuple(levels)
    keypoints_px, heat_maps = model.heat_maps(levels, _mode())
    return keypoints_px, heat_maps, model.features(levels, heat_maps, _mode())


def _read(prepared, inputs):
    return _module(prepared)._read_views(*inputs)


def _decode(prepared, inputs):
    start, tokens = inputs
    points = prepared.params["constants"]["basis_points"] / prepared.config.basis.radius
    return _module(prepared).decoder(start, points, tokens, prepared.constant["first"])


def _module(prepared):
    from poem_jax.models.network import assemble
    from poem_jax.models.poem_v2 import Poem

    model = assemble(prepared.config, prepared.params)
    assert isinstance(model, Poem), f"only POEM v2's parts are timed one by one; got {type(model).__name__}"
    return model


def _mode():
    from poem_jax.models.layers import NormMode

    return NormMode()


def _plain_program(name: str, config) -> Callable:
    import jax
    import plain_form  # beside this file

    return jax.jit(functools.partial(getattr(plain_form, name), config=config))


def _model(preset: str):
    """Return a config, and weights drawn by NumPy: those of `init` compile, and their offsets are zero."""
    import jax
    import numpy as np

    import poem_jax
    from poem_jax.geometry.neighbours import farthest_points
    from poem_jax.hand.model import template_queries
    from poem_jax.hand.template import default_hand
    from poem_jax.models.config import Config
    from poem_jax.models.network import describe
    from poem_jax.models.point_features import basis_points

    config, rng = poem_jax.preset(preset), np.random.default_rng(0)
    assert isinstance(config, Config), f"only POEM v2's models are timed; got {type(config).__name__}"
    shapes = describe(config)

    def draw(path, leaf):
        name = path[-1].key
        if name in ("scale", "variance"):
            # Residual branches and exchanges add little, so that the numbers stay near 1 to the end.
            small = name == "scale" and any(part.key in ("second", "expand", "fuse") for part in path)
            return np.full(leaf.shape, 0.1 if small else 1.0, np.float32)
        fan_in = np.prod(leaf.shape[-4:-1]) if name == "kernel" else 100
        if path[-2].key == "theta_out":  # the aggregation raises it to the third power
            fan_in *= 25
        return rng.standard_normal(leaf.shape, np.float32) / np.float32(np.sqrt(fan_in))

    groups = {name: shapes[name] for name in ("trainable", "statistics")}
    template = np.asarray(template_queries(default_hand(), config.decoder.query_order))
    constants = {
        "basis_points": basis_points(config.basis),
        "template_queries": template,
        "hand": default_hand()._asdict(),
    }
    if "anchors" in shapes["constants"]:
        index = farthest_points(template, config.decoder.num_neighbours)
        positions = (template[index] / config.basis.radius).astype(np.float32)
        constants["anchors"] = {"index": index, "positions": positions}
    return config, {**jax.tree_util.tree_map_with_path(draw, groups), "constants": constants}


def _scene(config, case: list[int]):
    """Return random images, cameras around one point and that point as root; `case` = views per sample."""
    import numpy as np

    import poem_jax
    from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle

    batch, views, rng, (h, w) = len(case), max(case), np.random.default_rng(0), config.image_hw
    images = rng.integers(0, 256, (batch, views, h, w, 3), dtype=np.uint8)
    K = np.array([[3.0 * w, 0, w / 2], [0, 3.0 * w, h / 2], [0, 0, 1]], np.float32)
    R = rotation_from_axis_angle(rng.normal(size=(batch, views, 3)))
    T_cam_from_world = rigid(R, np.tile([0.0, 0.0, 0.6], (batch, views, 1))).astype(np.float32)
    mask = np.arange(views) < np.array(case)[:, None]
    cams = poem_jax.Cameras(np.tile(K, (batch, views, 1, 1)), T_cam_from_world, mask)
    return images, cams, np.zeros((batch, 3), np.float32)


def _keep_programs(folder: str, case: list[int]) -> None:
    """Keep compiled programs in a folder of this case alone: none is found there that another case needed."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", os.path.join(folder, _key(case)))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _with_half_trunk(params):
    """Return the parameters with the trunk's in bfloat16."""
    import jax
    import jax.numpy as jnp

    def cast(part: dict) -> dict:
        return {**part, "trunk": jax.tree.map(lambda x: jnp.asarray(x, jnp.bfloat16), part["trunk"])}

    return {**params, "trainable": cast(params["trainable"]), "statistics": cast(params["statistics"])}


def _peak_gb() -> float:
    """Return the peak of this process so far; not `ru_maxrss`, which a child inherits from its parent."""
    try:
        with open("/proc/self/status") as lines:
            return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e9
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def _first_seconds(call: Callable) -> float:
    """Return the seconds of a first call, whatever was compiled before for another case."""
    import jax

    jax.clear_caches()
    return _seconds(call)


def _seconds(call: Callable) -> float:
    import jax

    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def _print_gpu() -> None:
    rows = []
    for name in PRESETS:
        for half in (False, True):
            got = _in_a_process("gpu", None, preset=name, half=half)
            kind = "trunk in bfloat16" if half else "float32"
            rows.append([name, kind, f"{got['ms']:.1f}", f"{got['rate']:.1f} (batch {got['batch']})"])
    print(f"\n### This GPU, {VIEWS[0]} views\n")
    _print_table(["preset", "", "ms a frame, batch 1", "frames/s, best batch"], rows)


if __name__ == "__main__":
    main()
