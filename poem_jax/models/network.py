"""Any system as one module, and its parameters as a plain pytree.

The way through a model is one: enter the working frame, `look` at every view, `find_hands` in what was seen,
leave the working frame. `forward` does it at once; `infer.py` looks view by view. Which module belongs to a
config is said in `systems.py`.
"""

import functools
import importlib
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.model import HandModel
from poem_jax.hand.template import default_hand
from poem_jax.models.config import Frozen, ModelConfig
from poem_jax.models.layers import NormMode, Row, recompute
from poem_jax.models.systems import MODULES
from poem_jax.models.world_frame import WorkingFrame, enter_working_frame
from poem_jax.typing import Array, Float, Int, Num, Params, PRNGKeyArray, PyTree

_MAX_SHOWN = 3
"""Mismatches that an error lists."""


class Constant(nnx.Variable):
    """An array that is stored with the weights and never trained."""


class StaticArray(np.ndarray):
    """Indices or flags among the constants: an array to all who read it, but no leaf of a pytree, so that
    nothing differentiates, casts or traces it."""


jax.tree_util.register_pytree_node(
    StaticArray, lambda array: ((), _ByValue(array)), lambda by_value, _: by_value.array
)


class _ByValue:
    """What `jit` compares to know a static array again."""

    def __init__(self, array: StaticArray) -> None:
        self.array, self.key = array, (array.dtype.str, array.shape, array.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByValue) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


FIRST_STAGE = ("trunk", "heat_maps")
"""The modules of a first stage, by their names in `params`; systems without heat maps have a trunk alone."""


def is_of_first_stage(name: str) -> bool:
    """Say it of a parameter by its dotted name, `trainable.trunk.stem.kernel`."""
    return name.split(".")[1] in FIRST_STAGE


GROUPS = {"trainable": nnx.Param, "statistics": nnx.BatchStat, "constants": Constant}
"""Which kind of variable each part of `params` holds."""


class HandConstants(nnx.Module):
    """The hand model's arrays, stored with the weights."""

    def __init__(self, hand: HandModel) -> None:
        for name, value in hand._asdict().items():
            setattr(self, name, Constant(np.asarray(value)))

    def model(self) -> HandModel:
        """Return them as a `HandModel`."""
        return HandModel(*(getattr(self, name)[...] for name in HandModel._fields))


@runtime_checkable
class System(Protocol):
    """What every system's `nnx.Module` has."""

    config: Any
    hand: HandConstants

    def look(self, views: Num[Array, "*batch h w 3"], mode: NormMode, settled: NormMode | None = None) -> Any:
        """Do everything that is done with every view alone; `settled`: the mode of trunk and heat maps, None
        = `mode`.

        Returns: a NamedTuple of arrays, their leading axes those of the views.
        """
        ...

    def find_hands(self, seen: Any, frame: WorkingFrame, mode: NormMode, **rest: Any) -> Prediction:
        """Join what was seen in the views (batch, view) to one hand per sample, in the user's world.

        `rest`: `dropout_key` in training; of systems whose config has a `grid_draw` also `ball_index` and
        `key` (`Draw`); and what the module's own `prepared` gave.
        """
        ...


@runtime_checkable
class Prepares(Protocol):
    """A system of which something does not depend on the images."""

    def prepared(self) -> dict[str, PyTree]:
        """Return arguments of `find_hands` that can be computed once."""
        ...


class Draw(NamedTuple):
    """Which points of the cameras' grids become basis points; both None = the system draws none."""

    ball_index: Int[Array, "batch point"] | None = None
    """Numbers in the grid (view, w, h, depth) of each sample, flattened; None = drawn."""
    key: PRNGKeyArray | None = None
    """What they are drawn with."""

    @classmethod
    def of(cls, config: ModelConfig, ball_index: Array | None, key: PRNGKeyArray | None) -> "Draw":
        """Return what a system needs: nothing, or the indices, or a key, by default key 0."""
        if config.grid_draw is None:
            return cls()
        if ball_index is not None:
            return cls(jnp.asarray(ball_index, jnp.int32))
        return cls(None, jax.random.key(0) if key is None else key)

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `find_hands` that it stands for."""
        return {} if self.ball_index is None and self.key is None else self._asdict()


def forward(
    params: Params,
    views: Num[Array, "batch view h w 3"],
    cams: Cameras,
    *,
    config: ModelConfig,
    root_world: Float[Array, "batch 3"] | None = None,
    train: bool = False,
    frozen: Frozen = Frozen.NOTHING,
    key: PRNGKeyArray | None = None,
    ball_index: Int[Array, "batch point"] | None = None,
    draw_key: PRNGKeyArray | None = None,
    axis_name: str | None = None,
    recomputed: tuple[type[Row], ...] = (),
) -> tuple[Prediction, dict]:
    """Do what `apply` does without its checks, and return the batch-norm statistics too.

    Args:
        params: from `init` or `load`.
        views: as in `apply`.
        cams: as in `apply`.
        config: the configuration that `params` were made with.
        root_world: as in `apply`, in training the noisy true root; NaN rows are triangulated.
        train: normalise by the moments of this batch's valid views and move the running statistics.
        frozen: in training, what does as at inference, and gets no gradient.
        key: in training, what dropout draws from; None = nothing is dropped.
        ball_index: as in `apply`.
        draw_key: the `key` of `apply`.
        axis_name: device axis over which the moments are averaged.
        recomputed: kinds of rows whose insides are computed again in the backward pass.

    Returns: the prediction, and the new `params["statistics"]` (unchanged unless `train`).

    Raises:
        ValueError: a padded number of views that the system cannot take.
    """
    frame = enter_working_frame(views, cams, root_world, number_type(params))
    model = assemble(config, _settled(params) if frozen is Frozen.FIRST_STAGE else params)
    recompute(model, recomputed)
    mode = NormMode(frame.cams.view_mask.reshape(-1) if train else None, axis_name)
    draw = Draw.of(config, ball_index, draw_key)
    dropout_key = key if train else None
    prediction = reconstruct(model, views, frame, mode, draw, dropout_key, frozen=frozen)
    return prediction, statistics(model) if train else params["statistics"]


def reconstruct(
    model: System,
    views: Num[Array, "batch view h w 3"],
    frame: WorkingFrame,
    mode: NormMode,
    draw: Draw,
    dropout_key: PRNGKeyArray | None = None,
    *,
    frozen: Frozen = Frozen.NOTHING,
) -> Prediction:
    """Reconstruct one hand per sample in the user's world, from within the working frame; `frozen` as in
    `forward`."""
    check_view_count(model.config, views.shape[1])
    shown = jnp.where(frame.cams.view_mask[..., None, None, None], views, 0)
    if frozen is Frozen.VIEWS:
        seen = jax.lax.stop_gradient(model.look(shown, NormMode()))
    else:
        seen = model.look(shown, mode, NormMode() if frozen is Frozen.FIRST_STAGE else None)
    return model.find_hands(seen, frame, mode, dropout_key=dropout_key, **draw.arguments())


def _settled(params: Params) -> Params:
    """Return the parameters, no gradient into those of the first stage."""
    trainable = params["trainable"]
    settled = {name: jax.lax.stop_gradient(trainable[name]) for name in FIRST_STAGE if name in trainable}
    return {**params, "trainable": {**trainable, **settled}}


def check_view_count(config: ModelConfig, num_views: int) -> None:
    """Raise `ValueError` for a padded number of views that a system cannot take."""
    least, most = config.view_range
    if num_views < least or (most is not None and num_views > most):
        what_helps = "Pad with masked ones" if num_views < least else "Leave some out"
        raise ValueError(
            f"`views` must have {config.views_in_words} views, as the layers of this {type(config).__name__} "
            f"are made for; got {num_views}. {what_helps}, or take a model for {num_views}"
        )


def number_type(params: Params) -> Any:
    """Return the number type in which a model computes."""
    return params["constants"]["hand"]["v_template"].dtype


class _Blueprint(NamedTuple):
    graph: Any
    states: dict[str, dict[tuple, Any]]


def build(config: ModelConfig, rngs: nnx.Rngs, hand: HandModel | None = None) -> System:
    """Make a model with fresh weights and the shipped hand, or another."""
    file, name = _home(config).split(":")
    module = getattr(importlib.import_module(file), name)
    return module(config, default_hand() if hand is None else hand, rngs=rngs)


def constants_of(config: ModelConfig, hand: HandModel) -> dict[str, Any]:
    """Return the constants of a model with a certain hand, as in `params["constants"]`."""
    return split(build(config, nnx.Rngs(0), hand))["constants"]


def _home(config: ModelConfig) -> str:
    if type(config) not in MODULES:
        known = ", ".join(sorted(kind.__name__ for kind in MODULES))
        raise ValueError(f"`config` must be of one of the classes {known}; got {type(config).__name__}")
    return MODULES[type(config)]


def split(model: System) -> Params:
    """Return the model's arrays."""
    params = {group: _nested(nnx.to_flat_state(nnx.state(model, kind))) for group, kind in GROUPS.items()}
    return with_static_indices(params)


def with_static_indices(params: Params) -> Params:
    """Make indices and flags among the constants static, so that `jax.grad` works on `params`."""

    def static(leaf: Array) -> Array:
        return leaf if jnp.issubdtype(leaf.dtype, jnp.floating) else np.asarray(leaf).view(StaticArray)

    return {**params, "constants": jax.tree.map(static, params["constants"])}


def leaves_with_names(tree: Any) -> dict[str, Array]:
    """List the arrays of a pytree by dotted path, static ones too."""
    leaves = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda leaf: isinstance(leaf, StaticArray))
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def statistics(model: System) -> dict[str, Any]:
    """Return the batch-norm statistics alone, as in `params["statistics"]`."""
    return _nested(nnx.to_flat_state(nnx.state(model, nnx.BatchStat)))


def assemble(config: ModelConfig, params: Params) -> System:
    """Return the model that holds the arrays of `params`."""
    blueprint = _blueprint(config)
    states = [
        nnx.from_flat_state(
            (path, variable.replace(_at(params[group], path))) for path, variable in flat.items()
        )
        for group, flat in blueprint.states.items()
    ]
    return nnx.merge(blueprint.graph, *states)


def describe(config: ModelConfig) -> Params:
    """Return the shapes and dtypes that `init` would give, without computing anything."""
    states = _blueprint(config).states
    return {group: _nested(flat.items()) for group, flat in states.items()}


@functools.lru_cache(maxsize=64)
def weights_of_kind(config: ModelConfig, kind: type[nnx.Param]) -> frozenset[tuple[str, ...]]:
    """Return the paths in `params["trainable"]` of one kind of weights: `Exact`, which are never cast, or
    `PerQuery`."""
    weights = _blueprint(config).states["trainable"]
    return frozenset(tuple(map(str, path)) for path, weight in weights.items() if isinstance(weight, kind))


def check_params(config: ModelConfig, params: Params) -> None:
    """Raise `ValueError` unless `params` has the paths and shapes of `config`."""
    expected, got = _shapes(describe(config)), _shapes(params)
    if expected == got:
        return
    names = sorted(name for name in expected.keys() | got.keys() if expected.get(name) != got.get(name))
    lines = [f"{name}: expected {expected.get(name)}, got {got.get(name)}" for name in names[:_MAX_SHOWN]]
    raise ValueError(
        f"`params` do not belong to `config`: {len(names)} entries differ, the first are {'; '.join(lines)}. "
        "Pass the config that the parameters were made or loaded with."
    )


class _SameKey(nnx.Rngs):
    """For weights of which only the shapes are wanted: under a trace Flax takes seconds to count keys."""

    def __init__(self, key: Array) -> None:
        super().__init__(0)
        self._key = key

    def params(self) -> Array:
        """Return the key."""
        return self._key


@functools.lru_cache(maxsize=32)
def _blueprint(config: ModelConfig) -> _Blueprint:
    abstract = nnx.eval_shape(lambda key: build(config, _SameKey(key)), jax.random.key(0))
    graph, *states = nnx.split(abstract, *GROUPS.values())
    return _Blueprint(graph, {g: dict(nnx.to_flat_state(s)) for g, s in zip(GROUPS, states, strict=True)})


def _nested(flat: Any) -> dict[str, Any]:
    """Nest (path, variable) pairs; list positions become string keys, which every file format keeps."""
    tree: dict[str, Any] = {}
    for path, variable in flat:
        node = tree
        for part in path[:-1]:
            node = node.setdefault(str(part), {})
        node[str(path[-1])] = variable.get_value()
    return tree


def _at(tree: dict[str, Any], path: tuple) -> Array:
    for part in path:
        tree = tree[str(part)]
    return jnp.asarray(tree)


def _shapes(params: Params) -> dict[str, tuple[int, ...]]:
    return {name: np.shape(leaf) for name, leaf in leaves_with_names(params).items()}
