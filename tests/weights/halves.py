"""A released model in two halves, traced with an ear on what its parts return and a hand on its searches."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.neighbours import nearest
from poem_jax.models import aggregation, decoder, heat_maps, layers, poem_v2, point_features, vector_attention
from poem_jax.models.backbones import HRNet
from poem_jax.models.config import Config
from poem_jax.models.network import assemble
from poem_jax.models.poem_v2 import ViewFeatures
from poem_jax.models.world_frame import WorkingFrame
from poem_jax.typing import Array, Params
from tests.weights.listening import Ears, listening


def _whole(args: tuple, out: Any) -> Any:
    return out


def _rows40(args: tuple, out: Any) -> Any:
    return out[:, ::40]


HEARD: Ears = {
    "levels": (HRNet, "__call__", _whole),
    "mlvl_feat": (point_features.BottomUpBranch, "__call__", _whole),
    "input_proj": (point_features.FeatureBranch, "__call__", _whole),
    "pooled": (heat_maps, "max_pool", _whole),
    "position": (point_features.ViewRowColumnCode, "__call__", _whole),
    "place_codes": (point_features, "place_codes", _whole),
    "sampled": (poem_v2, "projected_features", lambda args, out: (out[0][:, :, ::128], out[1])),
    "tokens": (aggregation, "row_major_tokens", lambda args, out: out[:, :, ::128]),
    "basis_features": (aggregation.ProjectiveAggregation, "__call__", lambda args, out: out[:, ::64]),
    "embedded": (
        decoder.MultiHeadAttention,
        "__call__",
        lambda args, out: (args[1][:, ::40], args[2][:, ::256]),
    ),
    "norms": (nnx.LayerNorm, "__call__", _rows40),
    "vec_self": (vector_attention.BracketedVectorAttention, "among_queries", _rows40),
    "vec_cross": (vector_attention.BracketedVectorAttention, "to_basis", _rows40),
    "out": (decoder.ReleaseLayer, "__call__", lambda args, out: out[0][:, ::40]),
    "neighbours": (decoder, "nearest_neighbours", lambda args, out: jnp.moveaxis(out.index, 0, -1)),
}
"""What is kept of every call of a function or method, in the order of the calls."""


@functools.partial(jax.jit, static_argnames="config")
def look(params: Params, views: Array, *, config: Config) -> tuple[ViewFeatures, dict[str, list]]:
    """Run what is done with every view alone."""
    model = assemble(config, params)
    with listening(HEARD) as heard:
        seen = model.look(views, layers.NormMode())
    heard["uv_logits"] = [model.heat_maps.to_logits(heard["pooled"][0])]
    return seen, dict(heard)


_IMAGES = 4
"""Of one run of `look_in_parts`."""


def look_in_parts(params: Params, views: np.ndarray, *, config: Config) -> ViewFeatures:
    """Look at a few images at a time: one program for batches of any shape."""
    batch, view = views.shape[:2]
    images = views.reshape(batch * view, 1, *views.shape[2:])
    missing = -len(images) % _IMAGES
    images = np.concatenate([images, np.zeros((missing, *images.shape[1:]), images.dtype)])
    parts = [_look(params, part, config=config) for part in np.split(images, len(images) // _IMAGES)]
    rows = [
        jnp.concatenate(leaves)[: batch * view] for leaves in zip(*map(jax.tree.leaves, parts), strict=True)
    ]
    leaves = [leaf.reshape(batch, view, *leaf.shape[2:]) for leaf in rows]
    return jax.tree.unflatten(jax.tree.structure(parts[0]), leaves)


@functools.partial(jax.jit, static_argnames="config")
def _look(params: Params, views: Array, *, config: Config) -> ViewFeatures:
    return assemble(config, params).look(views, layers.NormMode())


@functools.partial(jax.jit, static_argnames="config")
def find_hands(
    params: Params, seen: ViewFeatures, frame: WorkingFrame, swapped: Array, *, config: Config
) -> tuple[Prediction, Array, dict[str, list]]:
    """Run the rest; `swapped` (search, batch, query) read their 33rd nearest point in place of the 32nd.

    Returns: the prediction, how much farther the 33rd is (squared, units of 10 cm), and what was heard.
    """
    model, gaps = assemble(config, params), []
    with listening(HEARD) as heard, pytest.MonkeyPatch.context() as patch:
        patch.setattr(vector_attention, "nearest", nearest_but_for(swapped, gaps))
        prediction = model.find_hands(seen, frame, layers.NormMode())
    return prediction, jnp.stack(gaps), dict(heard)


def nearest_but_for(swapped: Array, gaps: list[Array]) -> Callable[[Array, Array, int], Array]:
    search = itertools.count()

    def find(queries: Array, points: Array, k: int) -> Array:
        index = nearest(queries, points, k + 1)
        ends = jax.vmap(lambda rows, i: rows[i])(points, index[..., k - 1 :])
        square = jnp.sum((queries[:, :, None] - ends) ** 2, -1)
        gaps.append(square[..., 1] - square[..., 0])
        last = jnp.where(swapped[next(search)], index[..., k], index[..., k - 1])
        return jnp.concatenate([index[..., : k - 1], last[..., None]], -1)

    return find
