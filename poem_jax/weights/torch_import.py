"""Released weights in, and ours out: between a PyTorch state dict and `(config, params)`.

Arrays only: no torch. `io/torch_file.py` reads and writes the files. The names of each system's arrays stand
in a table of their own; here is what they share.
"""

import importlib
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.hand import mano_file
from poem_jax.hand.model import HandModel, template_queries
from poem_jax.hand.topology import (
    NUM_FACES,
    NUM_POSE_FEATURES,
    NUM_QUERIES,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    NUM_VERTICES,
)
from poem_jax.models.config import Config, HRNetConfig, ModelConfig, ResNetConfig
from poem_jax.models.mesh_transformer_config import MeshTransformerConfig
from poem_jax.models.mvp_config import MvpConfig
from poem_jax.models.network import constants_of, describe, with_static_indices
from poem_jax.models.poem_v1_config import PoemV1Config
from poem_jax.models.presets import DATASETS, RELEASED, RELEASED_VIEWS, released
from poem_jax.typing import Float, Int, Params
from poem_jax.weights.name_table import NameRow, read_rows, write_rows
from poem_jax.weights.release_keys import HEAD, is_parametric
from poem_jax.weights.store import expected_leaves, flatten, unflatten
from poem_jax.weights.trunk_keys import trunk_rows

VARIANTS = tuple(RELEASED)
"""The released models; of POEM v2 each is the preset of that name with the suffix `-release`."""

KEYS: dict[type[ModelConfig], str] = {
    Config: "poem_jax.weights.release_keys",
    PoemV1Config: "poem_jax.weights.v1_poem_keys",
    MeshTransformerConfig: "poem_jax.weights.v1_mesh_keys",
    MvpConfig: "poem_jax.weights.v1_mvp_keys",
}
"""The file with the table of names of each system, by config class. It has `used_rows`,
`unused_shapes` and `hand_prefixes`, and may have `constant_rows` (what of a MANO asset goes beyond a hand
model) and `aliases` (further names of arrays; `unused_shapes` names them too)."""

_SHOWN = 12
_SAME_HAND_M = 1e-6
_ON_TEMPLATE_M = 1e-4
_BUFFERS = {
    "th_betas": (1, NUM_SHAPES),
    "th_shapedirs": (NUM_VERTICES, 3, NUM_SHAPES),
    "th_posedirs": (NUM_VERTICES, 3, NUM_POSE_FEATURES),
    "th_v_template": (1, NUM_VERTICES, 3),
    "th_J_regressor": (NUM_SKELETON_JOINTS, NUM_VERTICES),
    "th_weights": (NUM_VERTICES, NUM_SKELETON_JOINTS),
    "th_faces": (NUM_FACES, 3),
    "th_hands_mean": (1, 3 * (NUM_SKELETON_JOINTS - 1)),
}
"""What the hand layer of the released code keeps of a MANO file."""
_IGNORED_ENDINGS = ("embeddings.position_ids",)
"""Written by older versions of the library that the decoder came from."""
_CLASSIFIER = ("incre_modules.", "downsamp_modules.", "final_layer.", "classifier.", "fc.")
"""Heads of ImageNet checkpoints."""
_RESNET_STAGES = 4
"""Of every ResNet in torchvision."""

_log = logging.getLogger(__name__)


class Names(NamedTuple):
    """Every name in the state dict of one released model."""

    rows: list[NameRow]
    """Arrays that the forward pass uses."""
    unused: dict[str, tuple[int, ...]]
    """Shapes of arrays on which no output depends, and of aliases."""
    aliases: dict[str, str]
    """Further names of arrays, and the names in `rows` of the same arrays."""
    hands: dict[str, bool]
    """Prefixes of the buffers `th_*` that hold a MANO asset, and whether an output uses them."""


def names_of(config: ModelConfig) -> Names:
    """Return the names of the released model of this config."""
    keys = importlib.import_module(KEYS[type(config)])
    rows, aliases = list(keys.used_rows(config)), {}
    if hasattr(keys, "constant_rows"):
        rows += keys.constant_rows(config)
    if hasattr(keys, "aliases"):
        aliases = keys.aliases(config)
    return Names(rows, dict(keys.unused_shapes(config)), aliases, keys.hand_prefixes(config))


def convert(
    state_dict: Mapping[str, np.ndarray],
    variant: str,
    *,
    mano: HandModel | str | Path,
    basis_points: Float[np.ndarray, "*one basis 3"] | None = None,
    anchor_points: Float[np.ndarray, "*one anchor 3"] | None = None,
    anchor_indices: Int[np.ndarray, "*one anchor"] | None = None,
    dataset: str = "dexycb",
    num_views: int | None = None,
) -> tuple[ModelConfig, Params]:
    """Turn a released state dict into a model that `apply` runs.

    The hand is the one that the state dict carries, as in the released code; `mano` gives what its buffers do
    not say, and a warning is logged where the two differ.

    Args:
        state_dict: arrays by name; names may start with `module.`.
        variant: one of `VARIANTS`.
        mano: a right hand, or the path of a MANO `.pkl` or `.npz`.
        basis_points: POEM v2 alone, and needed there: `bps.npy` of the release, metres about the root.
        anchor_points: likewise `anchor.npy`, in units of 10 cm about the root. Whether they lie on the
            template of the hand is not checked here.
        anchor_indices: likewise `anchor_idx.npy`.
        dataset: POEM v1 and the baselines: what the model was trained on, one of `presets.DATASETS`. It fixes
            the space in which hands are sought, which the arrays do not tell.
        num_views: MvP alone: views that its layers are made for, None = as released (8 in DexYCB, 5 in HO3D,
            4 in OakInk); of another number a warning is logged.

    Returns: the config and the parameters, float32.

    Raises:
        ValueError: unknown variant or data set; constants that are missing, not asked for or of a wrong
            shape; a left hand; and, all reported together, names that are missing or unknown, arrays of
            another shape, and aliases that differ.
    """
    config = released(variant, dataset=dataset, num_views=num_views)
    assets = {
        "basis_points": basis_points,
        "anchor_points": anchor_points,
        "anchor_indices": anchor_indices,
    }
    _check_assets(assets, variant, needed=isinstance(config, Config))
    if config != released(variant, dataset=dataset):
        _log.warning(
            "the released %s of %s is made for %d views, not for %s: is `dataset` right? The space in which "
            "hands are sought is that of the data set",
            variant,
            dataset,
            RELEASED_VIEWS[dataset],
            num_views,
        )
    hand, names = _right_hand(mano), names_of(config)
    state = _without_prefix(state_dict)
    leaves, problems = read_rows(names.rows, state, expected_leaves(config))
    problems += _unknown_or_unlike(state, names) + _differing_aliases(state, names)
    if problems:
        raise ValueError(_report(problems, state, variant, config.view_range[1]))
    if isinstance(config, Config):
        leaves |= _constants(config, state, hand, names, **assets)
    else:
        leaves = _carried_constants(config, state, hand, names) | leaves
    _check_finite(leaves)
    return config, _params(config, leaves)


def _check_assets(assets: Mapping[str, Any], variant: str, *, needed: bool) -> None:
    wrong = [name for name, array in assets.items() if (array is None) == needed]
    if wrong:
        wanted = "is needed, from the folder `assets` of the release" if needed else "must be None"
        raise ValueError(f"for {variant} `{'`, `'.join(wrong)}` {wanted}")


def export_state_dict(config: ModelConfig, params: Params) -> dict[str, np.ndarray]:
    """Turn a model back into a state dict that the released code loads.

    Arrays on which no output of the release depends are zero (scales and variances of norms: one).

    Raises:
        ValueError: `config` is none of the released models.
    """
    if config not in _released_configs(config):
        raise ValueError(
            f"only the released models can be exported, those of the variants {', '.join(VARIANTS)}; got "
            "another config"
        )
    leaves, names = flatten(params), names_of(config)
    state = write_rows(names.rows, leaves)
    for name, shape in names.unused.items():
        state[name] = _neutral(name, shape)
    state |= {alias: state[first] for alias, first in names.aliases.items()}
    hand = HandModel(**{name: np.asarray(leaves[f"constants.hand.{name}"]) for name in HandModel._fields})
    for prefix in names.hands:
        state |= {prefix + name: array for name, array in _buffers(hand).items()}
    return state


def _released_configs(like: ModelConfig) -> Iterator[ModelConfig]:
    """List the released configs that `like` may be."""
    _, most = like.view_range
    for variant in RELEASED:
        for dataset in DATASETS:
            yield released(variant, dataset=dataset, num_views=most or 8)


def import_trunk(state_dict: Mapping[str, np.ndarray], config: ModelConfig, params: Params) -> Params:
    """Put ImageNet weights into the trunk of a model; all other parameters stay.

    Args:
        state_dict: HRNet's own names, or torchvision's for a ResNet; names may start with `module.`. The
            classifier is ignored, and so are the stages behind the last one of a ResNet that is cut short.
        config: the model; its trunk must be the one that the weights are of.
        params: its parameters.

    Raises:
        ValueError: all names that are missing or unknown and arrays of another shape.
    """
    trunk: HRNetConfig | ResNetConfig = config.backbone  # pyright: ignore[reportAttributeAccessIssue]
    state = _without_prefix(state_dict)
    rows = list(trunk_rows(trunk))
    leaves, problems = read_rows(rows, state, expected_leaves(config))
    known, ignored = {row.source for row in rows}, _CLASSIFIER + _stages_behind(trunk)
    problems += [
        f"{name}: unknown, got shape {array.shape}"
        for name, array in state.items()
        if name not in known and not name.startswith(ignored) and not name.endswith("num_batches_tracked")
    ]
    if problems:
        raise ValueError(
            f"the state dict is not a {type(trunk).__name__.removesuffix('Config')} of this size: "
            f"{_shown(problems)}. Give the weights of the trunk that `config.backbone` describes"
        )
    _check_finite(leaves)
    return unflatten({**flatten(params), **leaves}, params)


def _stages_behind(trunk: HRNetConfig | ResNetConfig) -> tuple[str, ...]:
    """Return how the names begin of torchvision's stages that a ResNet leaves out at its end."""
    if isinstance(trunk, HRNetConfig):
        return ()
    return tuple(f"layer{stage + 1}." for stage in range(len(trunk.blocks), _RESNET_STAGES))


def check_anchors(config: Config, params: Params, hand: HandModel) -> None:
    """Insist that the anchors of an imported model stand where the points that they name are, on the template
    that it carries and on that of `hand`.

    Raises:
        ValueError: they do not; the hand is another one than the weights were trained with.
    """
    constants = params["constants"]
    anchors, radius = constants["anchors"], config.basis.radius
    templates = np.stack([constants["template_queries"], template_queries(hand, config.decoder.query_order)])
    places = templates[:, np.asarray(anchors["index"])]
    gaps = np.linalg.norm(radius * np.asarray(anchors["positions"]) - places, axis=-1).max(0)
    if gaps.max() > _ON_TEMPLATE_M:
        raise ValueError(
            f"the anchors must lie on the template of the hand; {int((gaps > _ON_TEMPLATE_M).sum())} of "
            f"{len(gaps)} are up to {1000 * gaps.max():.1f} mm away. Give the anchors, checkpoint "
            "and hand of one release, or accept other anchors with --accept-anchors"
        )


def _without_prefix(state_dict: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Take `module.`, which parallel training adds, off all names."""
    state = {name.removeprefix("module."): np.asarray(array) for name, array in state_dict.items()}
    if len(state) < len(state_dict):
        twice = sorted(name for name in state if name in state_dict and f"module.{name}" in state_dict)
        raise ValueError(f"names must differ beyond the prefix `module.`; got these twice: {_shown(twice)}")
    return state


def _right_hand(mano: HandModel | str | Path) -> HandModel:
    hand = mano if isinstance(mano, HandModel) else mano_file.load(mano)
    if bool(hand.is_left):
        raise ValueError(
            "`mano` must be a right hand, as the released models were trained on; got a left one. Give "
            "MANO_RIGHT.pkl; left hands are mirrored before the model"
        )
    return hand


def _unknown_or_unlike(state: dict[str, np.ndarray], names: Names) -> list[str]:
    """List the problems of everything that the forward pass does not use."""
    shapes = names.unused | {
        prefix + name: shape for prefix in names.hands for name, shape in _BUFFERS.items()
    }
    live = {row.source for row in names.rows}
    problems = [f"{name}: missing, expected {shape}" for name, shape in shapes.items() if name not in state]
    for name, array in state.items():
        if name in shapes and array.shape != shapes[name]:
            problems.append(f"{name}: expected shape {shapes[name]}, got {array.shape}")
        if name not in shapes and name not in live and not name.endswith(_IGNORED_ENDINGS):
            problems.append(f"{name}: unknown, got shape {array.shape}")
    return problems


def _differing_aliases(state: dict[str, np.ndarray], names: Names) -> list[str]:
    """List the further names of an array that hold another one."""
    return [
        f"{alias}: expected the numbers of {first}, of which it is another name; got others"
        for alias, first in names.aliases.items()
        if {alias, first} <= state.keys() and not np.array_equal(state[alias], state[first])
    ]


def _report(problems: list[str], state: dict[str, np.ndarray], variant: str, most_views: int | None) -> str:
    looks_like, views = _guess(state)
    hint = "Is the file cut short, or of another model?"
    if most_views is not None:
        hint = f"Is the file cut short, of another model, or not of `num_views` = {most_views}?"
    if looks_like not in (None, variant):
        hint = f"The state dict looks like {looks_like}: pass that variant."
    if views not in (None, most_views):
        hint = f"{hint} It looks made for {views} views: pass its data set, or that as `num_views`."
    return f"the state dict does not fit {variant}: {_shown(problems)}. {hint}"


def _guess(state: dict[str, np.ndarray]) -> tuple[str | None, int | None]:
    """Tell the variant by the width of the query embeddings and by the parametric head, and the number of
    views of one that is made for a number."""
    table = state.get(f"{HEAD}query_feat_embedding.weight")
    if table is None or table.ndim != 2:
        return _guess_by_names(state)
    parametric = any(name.endswith("mano_linear.weight") for name in state)
    for variant in RELEASED:
        config = released(variant)
        if isinstance(config, Config) and (config.width, is_parametric(config)) == (
            table.shape[1],
            parametric,
        ):
            return variant, None
    return None, None


def _guess_by_names(state: dict[str, np.ndarray]) -> tuple[str | None, int | None]:
    """Return the variant, not of POEM v2, that has exactly these names and shapes, if one has."""
    for variant in RELEASED:
        for config in {released(variant, num_views=views): None for views in RELEASED_VIEWS.values()}:
            if isinstance(config, Config):
                continue
            names = names_of(config)
            if any(row.source not in state for row in names.rows):
                continue
            _, problems = read_rows(names.rows, state, expected_leaves(config))
            if not problems and not _unknown_or_unlike(state, names):
                return variant, config.view_range[1]
    return None, None


def _shown(problems: list[str]) -> str:
    more = f"; and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
    return f"{len(problems)} problems: {'; '.join(problems[:_SHOWN])}{more}"


def _carried_constants(
    config: ModelConfig, state: dict[str, np.ndarray], hand: HandModel, names: Names
) -> dict[str, np.ndarray]:
    """Return what a fresh model with the hand of the state dict has for constants."""
    prefix = next((prefix for prefix, used in names.hands.items() if used), next(iter(names.hands)))
    return flatten({"constants": constants_of(config, _carried_hand(state, prefix, hand))})


def _constants(
    config: Config,
    state: dict[str, np.ndarray],
    hand: HandModel,
    names: Names,
    *,
    basis_points: Any,
    anchor_points: Any,
    anchor_indices: Any,
) -> dict[str, np.ndarray]:
    prefixes = [prefix for prefix, used in names.hands.items() if used]
    # The head's hand gives the template, the last layer's the parametric output.
    template_hand, output_hand = (
        _carried_hand(state, prefix, hand) for prefix in (prefixes[0], prefixes[-1])
    )
    count, k = config.basis.num_points, config.decoder.num_neighbours
    index = _shaped("anchor_indices", anchor_indices, (k,))
    if index.dtype.kind not in "iu" or index.min() < 0 or index.max() >= NUM_QUERIES:
        raise ValueError(f"`anchor_indices` must be whole numbers from 0 to {NUM_QUERIES - 1}; got {index}")
    return {
        "constants.basis_points": _shaped("basis_points", basis_points, (count, 3)).astype(np.float32),
        "constants.template_queries": template_queries(template_hand, config.decoder.query_order),
        "constants.anchors.index": index.astype(np.int32),
        "constants.anchors.positions": _shaped("anchor_points", anchor_points, (k, 3)).astype(np.float32),
        **{f"constants.hand.{name}": np.asarray(value) for name, value in output_hand._asdict().items()},
    }


def _shaped(name: str, array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(array)
    if array.shape not in (shape, (1, *shape)):
        raise ValueError(f"`{name}` must have shape {shape} or {(1, *shape)}; got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite; got NaN or infinity")
    return array.reshape(shape)


def _carried_hand(state: dict[str, np.ndarray], prefix: str, hand: HandModel) -> HandModel:
    """Return the hand in the buffers of a state dict; faces and side are those of `hand`."""
    fields = {
        name: state[f"{prefix}th_{name}"].astype(np.float32).reshape(getattr(hand, name).shape)
        for name in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights")
    }
    gaps = {name: float(np.abs(field - getattr(hand, name)).max()) for name, field in fields.items()}
    if max(gaps.values()) > _SAME_HAND_M:
        _log.warning(
            "the hand in %s differs from `mano` (%s); that of the weights is used",
            prefix,
            ", ".join(f"{name} by up to {gap:.2g}" for name, gap in gaps.items() if gap > _SAME_HAND_M),
        )
    if np.any(state[f"{prefix}th_hands_mean"]):
        _log.warning(
            "%sth_hands_mean is not zero and is ignored: the released models have a flat hand", prefix
        )
    return hand._replace(**fields)


def _buffers(hand: HandModel) -> dict[str, np.ndarray]:
    values = {
        "th_v_template": hand.v_template,
        "th_shapedirs": hand.shapedirs,
        "th_posedirs": hand.posedirs,
        "th_J_regressor": hand.J_regressor,
        "th_weights": hand.weights,
        "th_faces": hand.faces.astype(np.int64),
    }
    return {
        name: np.ascontiguousarray(values.get(name, np.zeros(shape, np.float32))).reshape(shape)
        for name, shape in _BUFFERS.items()
    }


def _neutral(name: str, shape: tuple[int, ...]) -> np.ndarray:
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    is_norm = len(shape) == 1 and name.endswith((".weight", "running_var"))
    return (np.ones if is_norm else np.zeros)(shape, np.float32)


def _check_finite(leaves: dict[str, np.ndarray]) -> None:
    broken = sorted(
        name for name, leaf in leaves.items() if leaf.dtype.kind == "f" and not np.isfinite(leaf).all()
    )
    if broken:
        raise ValueError(
            f"weights must be finite; {len(broken)} arrays hold NaN or infinity: "
            f"{', '.join(broken[:_SHOWN])}. Take a checkpoint from before the training failed"
        )


def _params(config: ModelConfig, leaves: dict[str, np.ndarray]) -> Params:
    """Nest the leaves; every one of the model's must be there."""
    template = expected_leaves(config)
    missing = template.keys() - leaves.keys()
    assert not missing, f"the table fills no {sorted(missing)}"
    typed = {name: leaves[name].astype(leaf.dtype) for name, leaf in template.items()}
    return with_static_indices(unflatten(typed, describe(config)))
