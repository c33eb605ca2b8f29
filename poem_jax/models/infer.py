"""Inference at the cost of the views that exist: `prepare` once, then `infer`.

`apply` is one pure program over padded views. Here the valid views of a batch are packed into chunks of a
fixed size for the trunk, which is most of the work, and the hand is then found sample by sample, so that the
cost follows the views that there are. All shapes are fixed by the padded batch: once the few programs below
are there, new masks compile nothing.

On a CPU a chunk is two views, which read the weights once, or one, and as many threads as cores each run a
program that uses one thread: XLA:CPU shares a single convolution badly among cores. Programs for few and for
many parts differ, and those for one and two views, so that a padded batch compiles at most three of the first
half and two of the second. Accelerators take the chunks one after the other; nothing was measured there.
"""

import contextlib
import functools
import itertools
import math
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.extend.core import ClosedJaxpr, Jaxpr

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras
from poem_jax.io.compiler_options import cpu_options
from poem_jax.models import network
from poem_jax.models.apply import check_inputs, check_solved
from poem_jax.models.config import ModelConfig
from poem_jax.models.layers import Conv, NormMode
from poem_jax.models.world_frame import WorkingFrame, enter_working_frame, is_traced
from poem_jax.typing import Array, Float, Int, Num, Params, PRNGKeyArray, PyTree

_VIEWS_AT_A_TIME = 8
"""Views that an accelerator takes at a time."""


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=["params", "constant"], meta_fields=["config"]
)
@dataclass(frozen=True)
class Prepared:
    """A model ready for inference: its parameters, and what does not depend on the images."""

    params: Params
    """Those given, but on a CPU with kernels of wide convolutions transformed (`winograd.py`)."""
    constant: dict[str, PyTree] | None
    """Arguments of `find_hands` that do not depend on the images, if the system has any."""
    config: ModelConfig


def prepare(params: Params, config: ModelConfig) -> Prepared:
    """Check the parameters and compute what is constant in them.

    Raises:
        ValueError: `params` of another config.
    """
    network.check_params(config, params)
    prepared = _with_transformed_kernels(params, config) if _on_cpu() else params
    return jax.device_put(Prepared(prepared, _constant(params, config), config))


def _with_transformed_kernels(params: Params, config: ModelConfig) -> Params:
    """Prepare the convolutions that look at the views, each for the smallest map that its shape sees."""
    images = jax.ShapeDtypeStruct((1, *config.image_hw, 3), np.uint8)
    program = jax.make_jaxpr(_look)(Prepared(params, None, config), images)
    pixels: dict[tuple[int, ...], int] = {}
    for x, kernel in _convolutions(program.jaxpr):
        pixels[kernel] = min(math.prod(x[1:3]), pixels.get(kernel, sys.maxsize))
    model = network.assemble(config, params)
    for _, part in nnx.iter_graph(model):
        if isinstance(part, Conv):
            part.prepare_for_cpu(pixels.get(part.kernel[...].shape[-4:], 0))
    return network.split(model)


def _convolutions(program: Jaxpr) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
    """List the shapes of images and kernel of every convolution in a program."""
    for step in program.eqns:
        if step.primitive.name == "conv_general_dilated":
            x, kernel = (variable.aval for variable in step.invars)
            yield x.shape, kernel.shape  # pyright: ignore[reportAttributeAccessIssue]
        for inner in step.params.values():
            if isinstance(inner, ClosedJaxpr | Jaxpr):
                yield from _convolutions(inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner)


def infer(
    prepared: Prepared,
    views: Num[Array, "batch view h w 3"],
    cams: Cameras,
    *,
    root_world: Float[Array, "batch 3"] | None = None,
    ball_index: Int[Array, "batch point"] | None = None,
    key: PRNGKeyArray | None = None,
) -> Prediction:
    """Do what `apply` does, faster: the same arguments, results and errors, for concrete inputs only.

    Not pure: it looks at `cams.view_mask` to skip the views that are not there. `heat_maps` and
    `keypoints_px` of masked views, where the system has them, are zero.

    Raises:
        ValueError: as `apply`, and traced inputs.
    """
    if is_traced(views, cams, root_world, ball_index, key):
        raise ValueError("`infer` looks at the values of its inputs; under jit, grad or vmap use `apply`")
    check_inputs(views, cams, root_world, prepared.config, ball_index, key)
    frame = _frame(prepared, views, cams, root_world)
    draw = network.Draw.of(prepared.config, ball_index, key)
    prediction = _infer_in_frame(prepared, views, frame, draw)
    check_solved(prediction, frame, prepared.config)
    return prediction


def infer_unchecked(
    prepared: Prepared,
    views: Num[Array, "batch view h w 3"],
    cams: Cameras,
    *,
    root_world: Float[Array, "batch 3"] | None = None,
    ball_index: Int[Array, "batch point"] | None = None,
    key: PRNGKeyArray | None = None,
) -> Prediction:
    """Do what `infer` does without its checks: a sample that cannot be solved has `valid` False.

    A view that is masked, or whose image or camera is not finite, is left out. On a CPU a sample without any
    view costs nothing and is zero.

    Raises:
        ValueError: a padded number of views that the system cannot take.
    """
    network.check_view_count(prepared.config, views.shape[1])
    draw = network.Draw.of(prepared.config, ball_index, key)
    return _infer_in_frame(prepared, views, _frame(prepared, views, cams, root_world), draw)


def _frame(prepared: Prepared, views: Array, cams: Cameras, root_world: Array | None) -> WorkingFrame:
    concrete = (np.asarray(views), Cameras(*map(np.asarray, cams)), root_world)
    return enter_working_frame(*concrete, network.number_type(prepared.params))


def _infer_in_frame(prepared: Prepared, views: Array, frame: WorkingFrame, draw: network.Draw) -> Prediction:
    seen = _look_at_valid(prepared, np.asarray(views), frame.cams.view_mask)
    return _find_hands(prepared, _Samples(seen, frame, draw.ball_index), draw.key)


def _look_at_valid(prepared: Prepared, views: np.ndarray, valid: np.ndarray) -> PyTree:
    """Run the trunk over the valid views, chunk by chunk; masked views get zeros."""
    packed = views[valid]
    sizes = _chunk_sizes(len(packed))
    packed = np.concatenate([packed, np.zeros((sum(sizes) - len(packed), *packed.shape[1:]), packed.dtype)])
    starts = [0, *itertools.accumulate(sizes)]
    spare = 1 if _on_cpu() else _VIEWS_AT_A_TIME
    buffers = _empty_features(prepared, views.dtype, valid.size + spare)
    chunks = [packed[start:end] for start, end in itertools.pairwise(starts)]
    for seen, start in zip(_run_all(_look, prepared, chunks), starts[:-1], strict=True):
        buffers = _write(buffers, seen, start)
    place = np.where(valid, np.cumsum(valid).reshape(valid.shape) - 1, valid.size)
    return _read(buffers, place)


def _chunk_sizes(count: int) -> list[int]:
    """Divide views into chunks: on a CPU pairs, as long as there is one for every core, then single ones."""
    if not _on_cpu():
        return [_VIEWS_AT_A_TIME] * -(-count // _VIEWS_AT_A_TIME)
    pairs = count // (2 * _cores()) * _cores()
    return [2] * pairs + [1] * (count - 2 * pairs)


class _Samples(NamedTuple):
    """What the second half needs of each sample."""

    seen: Any
    """The features of its views."""
    frame: WorkingFrame
    ball_index: Int[Array, "batch point"] | None


def _find_hands(prepared: Prepared, samples: _Samples, key: PRNGKeyArray | None) -> Prediction:
    """Run the second half: on accelerators the whole batch at once, on a CPU sample by sample, unless they
    depend on each other."""
    if not _on_cpu():
        return _find(prepared, (samples, key))
    if prepared.config.couples_samples:
        return _run_all(_find, prepared, [(samples, key)])[0]
    mask = samples.frame.cams.view_mask
    rows = np.flatnonzero(mask.any(-1)) if mask.any() else np.array([0])
    parts = [(jax.tree.map(lambda leaf, row=row: leaf[row : row + 1], samples), key) for row in rows]
    found = dict(zip(rows.tolist(), _run_all(_find, prepared, parts), strict=True))
    empty = jax.tree.map(jnp.zeros_like, found[int(rows[0])])
    ordered = [found.get(row, empty) for row in range(len(mask))]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *ordered)


def _run_all(function: Callable, prepared: Prepared, parts: list) -> list:
    """Apply a function of (prepared, part) to all parts.

    On a CPU they run side by side, one thread each, if that keeps more than half of the cores busy;
    otherwise, and on accelerators, one after the other.
    """
    cores = _cores()
    if not _on_cpu():
        return [function(prepared, part) for part in parts]
    side_by_side = 2 * len(parts) > cores
    program = _cpu_program(function, side_by_side)
    if not side_by_side:
        return [program(prepared, part) for part in parts]
    settings = _thread_settings()

    def work(part: Any) -> Any:
        with contextlib.ExitStack() as stack:
            for setting in settings:
                stack.enter_context(setting())
            # Waiting inside the thread is what keeps one program in each.
            return jax.block_until_ready(program(prepared, part))

    with ThreadPoolExecutor(min(cores, len(parts))) as pool:
        return list(pool.map(work, parts))


def _thread_settings() -> list[Callable[[], Any]]:
    """Return what re-enters the caller's JAX settings, which a new thread does not inherit."""
    values = jax.config.values
    x64, precision, device = (
        values[name] for name in ("jax_enable_x64", "jax_default_matmul_precision", "jax_default_device")
    )
    return [
        lambda: jax.enable_x64(x64),
        lambda: jax.default_matmul_precision(precision),
        lambda: jax.default_device(device),
    ]


def _cores() -> int:
    """Count the cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"


@jax.jit
def _look(prepared: Prepared, views: Array) -> PyTree:
    return network.assemble(prepared.config, prepared.params).look(views, NormMode())


@jax.jit
def _find(prepared: Prepared, given: tuple[_Samples, PRNGKeyArray | None]) -> Prediction:
    (seen, frame, ball_index), key = given
    model = network.assemble(prepared.config, prepared.params)
    draw = network.Draw(ball_index, key)
    return model.find_hands(seen, frame, NormMode(), **(prepared.constant or {}), **draw.arguments())


@functools.cache
def _cpu_program(function: Callable, one_thread: bool) -> Callable:
    """Return a jitted function compiled anew for a CPU."""
    plain = function.__wrapped__  # pyright: ignore[reportFunctionMemberAccess]
    return jax.jit(plain, compiler_options=cpu_options(one_thread=one_thread))


@functools.partial(jax.jit, static_argnames="config")
def _constant(params: Params, config: ModelConfig) -> dict[str, PyTree] | None:
    model = network.assemble(config, params)
    return model.prepared() if isinstance(model, network.Prepares) else None


@functools.partial(jax.jit, static_argnums=(1, 2))
def _empty_features(prepared: Prepared, image_dtype: np.dtype, count: int) -> PyTree:
    image = jax.ShapeDtypeStruct((1, *prepared.config.image_hw, 3), image_dtype)
    shapes = jax.eval_shape(_look, prepared, image)
    return jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape[1:]), leaf.dtype), shapes)


@functools.partial(jax.jit, donate_argnums=0)
def _write(buffers: PyTree, seen: PyTree, start: Array) -> PyTree:
    return jax.tree.map(
        lambda buffer, part: jax.lax.dynamic_update_slice_in_dim(buffer, part, start, 0), buffers, seen
    )


@jax.jit
def _read(buffers: PyTree, place: Array) -> PyTree:
    """Take the rows of the valid views; the row behind the last view is nobody's."""

    def rows(buffer: Array) -> Array:
        empty = (place == place.size).reshape(*place.shape, *[1] * (buffer.ndim - 1))
        return jnp.where(empty, 0, buffer[place])

    return jax.tree.map(rows, buffers)
