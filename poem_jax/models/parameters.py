"""Modules as plain pytrees, nested dicts of arrays in `trainable`, `statistics`, `constants`, and back."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.hand.template import default_hand
from poem_jax.models.config import Config
from poem_jax.models.reconstruction import Constant, Poem
from poem_jax.typing import Array, Params

GROUPS = {"trainable": nnx.Param, "statistics": nnx.BatchStat, "constants": Constant}
"""Which kind of variable each part of `params` holds."""
_SHOWN_MISMATCHES = 3


class _Blueprint(NamedTuple):
    graph: Any
    states: dict[str, dict[tuple, Any]]


def build(config: Config, rngs: nnx.Rngs) -> Poem:
    """Make a model with fresh weights and the shipped hand."""
    return Poem(config, default_hand(), rngs=rngs)


def split(model: Poem) -> Params:
    """Return the model's arrays."""
    return {group: _nested(nnx.to_flat_state(nnx.state(model, kind))) for group, kind in GROUPS.items()}


def statistics(model: Poem) -> dict[str, Any]:
    """Return the batch-norm statistics alone, as in `params["statistics"]`."""
    return _nested(nnx.to_flat_state(nnx.state(model, nnx.BatchStat)))


def assemble(config: Config, params: Params) -> Poem:
    """Return the model that holds the arrays of `params`."""
    blueprint = _blueprint(config)
    states = [
        nnx.from_flat_state(
            (path, variable.replace(_at(params[group], path))) for path, variable in flat.items()
        )
        for group, flat in blueprint.states.items()
    ]
    return nnx.merge(blueprint.graph, *states)


def describe(config: Config) -> Params:
    """Return the shapes and dtypes that `init` would give, without computing anything."""
    states = _blueprint(config).states
    return {group: _nested(flat.items()) for group, flat in states.items()}


def check_params(config: Config, params: Params) -> None:
    """Raise `ValueError` unless `params` has the paths and shapes of `config`."""
    expected, got = _shapes(describe(config)), _shapes(params)
    if expected == got:
        return
    names = sorted(name for name in expected.keys() | got.keys() if expected.get(name) != got.get(name))
    lines = [
        f"{name}: expected {expected.get(name)}, got {got.get(name)}" for name in names[:_SHOWN_MISMATCHES]
    ]
    raise ValueError(
        f"`params` do not belong to `config`: {len(names)} entries differ, the first are {'; '.join(lines)}. "
        "Pass the config that the parameters were made or loaded with."
    )


@functools.lru_cache(maxsize=32)
def _blueprint(config: Config) -> _Blueprint:
    abstract = nnx.eval_shape(lambda: build(config, nnx.Rngs(0)))
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
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {"/".join(str(part.key) for part in path): np.shape(leaf) for path, leaf in leaves}
