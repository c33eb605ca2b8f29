"""Names of the released PE-MeshTR and FTL-MeshTR: the arrays that matter, and those that no output depends
on.

`used_rows` and `unused_shapes` together are the whole state dict, but for the buffers that hold the MANO
asset (`hand_prefixes`). The network after the decoder is listed once a layer: all but the first are `aliases`
(`unused_shapes` names them too).
"""

from collections.abc import Iterator
from dataclasses import replace

from poem_jax.models.config import ResNetConfig
from poem_jax.models.mesh_transformer_config import (
    CanonicalFusion,
    MeshTransformerConfig,
    PositionEmbeddedFusion,
)
from poem_jax.weights.name_table import (
    NameRow,
    NameRows,
    attention,
    conv_norm,
    convolution,
    layer_norm,
    linear,
)
from poem_jax.weights.trunk_keys import resnet_rows

TRUNK = "img_backbone."
HEAD = "head."
_DECODER = f"{HEAD}transformer.decoder."
_CLASSES = 1000
"""Of ImageNet."""
_INHERITED_DEPTHS = 64
"""Points along a ray of the grid encoder that FTL-MeshTR inherits and never runs."""

Shapes = Iterator[tuple[str, tuple[int, ...]]]


def used_rows(config: MeshTransformerConfig) -> NameRows:
    """List the arrays that the forward pass uses, each under its first name."""
    yield from resnet_rows(config.backbone, TRUNK)
    yield from convolution(f"{HEAD}input_proj", "features.project")
    yield from _pair(f"{HEAD}adapt_pos3d", "fusion.place_code.mix")
    if isinstance(config.fusion, PositionEmbeddedFusion):
        yield from _pair(f"{HEAD}position_encoder", "fusion.grid_code")
    else:
        for i, path in enumerate(("to_points", "between", "from_points"), 1):
            yield from conv_norm(f"{HEAD}conv{i}.0", f"{HEAD}conv{i}.1", f"fusion.{path}", bias=True)
    yield NameRow(f"{HEAD}reference_points.weight", "trainable.queries.points")
    yield from linear(f"{HEAD}query_embedding.0", "queries.hidden")
    yield from linear(f"{HEAD}query_embedding.2", "queries.out")
    for i in range(config.decoder.num_layers):
        yield from _layer_rows(f"{_DECODER}layers.{i}", f"decoder.layers.{i}")
    yield from layer_norm(f"{_DECODER}post_norm", "decoder.norm")
    for i, path in enumerate(("hidden.0", "hidden.1", "out")):
        yield from linear(f"{_branch(0)}.{2 * i}", f"offsets.{path}")


def _pair(source: str, path: str) -> NameRows:
    """List two 1 x 1 convolutions with a ReLU between them."""
    yield from convolution(f"{source}.0", f"{path}.hidden")
    yield from convolution(f"{source}.2", f"{path}.out")


def _layer_rows(source: str, path: str) -> NameRows:
    for i, ours in enumerate(("self_attention", "cross_attention")):
        yield from attention(f"{source}.attentions.{i}.attn", f"{path}.{ours}")
    yield from linear(f"{source}.ffns.0.layers.0.0", f"{path}.hidden")
    yield from linear(f"{source}.ffns.0.layers.1", f"{path}.out")
    for i in range(3):
        yield from layer_norm(f"{source}.norms.{i}", f"{path}.norms.{i}")


def _branch(layer: int) -> str:
    return f"{HEAD}reg_branches.{layer}"


def aliases(config: MeshTransformerConfig) -> dict[str, str]:
    """Return the further names of arrays, and the name under which `used_rows` lists each."""
    first = [row.source for row in used_rows(config) if row.source.startswith(_branch(0))]
    layers = range(1, config.decoder.num_layers)
    return {name.replace(_branch(0), _branch(i)): name for i in layers for name in first}


def hand_prefixes(config: MeshTransformerConfig) -> dict[str, bool]:
    """Return the prefixes of the buffers `th_*` that hold a MANO asset, and whether an output uses them.

    PE-MeshTR's queries know the template; FTL-MeshTR's do not.
    """
    return {"mano_layer.": isinstance(config.fusion, PositionEmbeddedFusion)}


def unused_shapes(config: MeshTransformerConfig) -> dict[str, tuple[int, ...]]:
    """Return name and shape of every array that no output depends on, or that has a name already, but for the
    hand's buffers."""
    shapes = dict(_alias_shapes(config)) | dict(_unused_trunk(config))
    if isinstance(config.fusion, CanonicalFusion):
        hidden = 4 * config.width
        shapes |= dict(_layer(f"{HEAD}position_encoder.0", (hidden, 3 * _INHERITED_DEPTHS, 1, 1)))
        shapes |= dict(_layer(f"{HEAD}position_encoder.2", (config.width, hidden, 1, 1)))
    return shapes | {name: () for name in _counters(config)}


def _alias_shapes(config: MeshTransformerConfig) -> Shapes:
    width = config.width
    for i in range(1, config.decoder.num_layers):
        for number, rows in ((0, width), (2, width), (4, 3)):
            yield from _layer(f"{_branch(i)}.{number}", (rows, width))


def _whole_trunk(config: MeshTransformerConfig) -> ResNetConfig:
    whole = ResNetConfig.resnet34()
    return replace(config.backbone, blocks=whole.blocks, channels=whole.channels)


def _unused_trunk(config: MeshTransformerConfig) -> Shapes:
    """Stages 3 and 4, and the classifier."""
    whole, built = _whole_trunk(config), {row.source for row in resnet_rows(config.backbone, TRUNK)}
    for row in resnet_rows(whole, TRUNK):
        if row.source not in built:
            yield row.source, _trunk_shape(whole, row)
    yield from _layer(f"{TRUNK}fc", (_CLASSES, whole.channels[-1]))


def _trunk_shape(trunk: ResNetConfig, row: NameRow) -> tuple[int, ...]:
    """Return the shape of an array of a stage behind the first."""
    _, _, _, stage, _, block, part, *_ = row.path.split(".")
    c_out = trunk.channels[int(stage)]
    if not row.path.endswith(".conv.kernel"):
        return (c_out,)
    starts = block == "0" and part != "second"
    size = 1 if part == "shortcut" else 3
    return (c_out, trunk.channels[int(stage) - 1] if starts else c_out, size, size)


def _counters(config: MeshTransformerConfig) -> Iterator[str]:
    """Every batch norm that is not frozen counts its batches."""
    rows = [*resnet_rows(_whole_trunk(config), TRUNK), *used_rows(config)]
    trained = {row.source for row in rows if row.path.startswith("trainable.")}
    norms = dict.fromkeys(
        row.source.removesuffix("running_mean") for row in rows if row.source.endswith("running_mean")
    )
    return (f"{norm}num_batches_tracked" for norm in norms if f"{norm}weight" in trained)


def _layer(source: str, shape: tuple[int, ...]) -> Shapes:
    yield f"{source}.weight", shape
    yield f"{source}.bias", shape[:1]
