"""Names of the released POEM-v2 models: the arrays that matter, and those that no output depends on.

`used_rows` and `unused_shapes` together are the whole state dict, but for the buffers that
hold the MANO asset (`hand_prefixes`).
"""

from collections.abc import Iterator

from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES, NUM_SHAPES, NUM_SKELETON_JOINTS
from poem_jax.models.config import Config, DecoderOutput, HRNetConfig
from poem_jax.weights.name_table import NameRow, NameRows, conv_norm, convolution, layer_norm, linear
from poem_jax.weights.trunk_keys import hrnet_rows

TRUNK = "img_backbone."
HEAD = "ptEmb_head."
_BLOCKS = f"{HEAD}transformer.pt_metro_encoder."
_WORDS, _POSITIONS, _TYPES = 30522, 4096, 2
"""Rows of the tables of the language model that the decoder's code was taken from."""
_DEPTH_NUMBERS, _GLOBAL_NUMBERS = 96, 512
_HAND_NUMBERS = 6 * NUM_SKELETON_JOINTS + NUM_SHAPES

Shapes = Iterator[tuple[str, tuple[int, ...]]]


def is_parametric(config: Config) -> bool:
    """Whether the model regresses pose and shape."""
    return config.decoder.output is DecoderOutput.HAND_PARAMETERS


def used_rows(config: Config) -> NameRows:
    """List the arrays that the forward pass uses."""
    assert isinstance(config.backbone, HRNetConfig)
    yield from hrnet_rows(config.backbone, TRUNK)
    for i in range(3):
        for name, path in (("feat", "features.branch.reductions"), ("uv", "heat_maps.branch.merges")):
            source = f"{name}_delayer.{i}"
            yield from conv_norm(f"{source}.conv", f"{source}.norm", f"{path}.{i}", bias=True)
    yield from convolution("feat_in.conv", "features.branch.squeeze")
    yield from convolution("uv_out.conv", "heat_maps.to_logits")
    yield from convolution(f"{HEAD}input_proj", "features.project")
    yield from convolution(f"{HEAD}adapt_pos3d", "features.position.mix")
    for i, network in enumerate(("theta", "phi")):
        yield from linear(f"{HEAD}merge_net_feature.{i}.0", f"aggregation.{network}_in")
        yield from linear(f"{HEAD}merge_net_feature.{i}.2", f"aggregation.{network}_out")
    yield NameRow(f"{HEAD}query_feat_embedding.weight", "trainable.decoder.embeddings")
    last = config.decoder.num_layers - 1
    for i in range(last + 1):
        yield from _layer_rows(i, moves=i < last or not is_parametric(config), is_last=i == last)
    if is_parametric(config):
        yield from linear(f"{_BLOCKS}{last}.flat_verts", "regressor.pool")
        yield from linear(f"{_BLOCKS}{last}.mano_linear", "regressor.regress")


def _layer_rows(i: int, *, moves: bool, is_last: bool) -> NameRows:
    source, path = f"{_BLOCKS}{i}", f"decoder.layers.{i}"
    yield from linear(f"{source}.embedding", f"{path}.embed")
    for n, (theirs, ours) in enumerate((("attn", "self_attention"), ("cross_attn", "cross_attention"))):
        for part in ("query", "key", "value"):
            yield from linear(f"{source}.encoder.{theirs}.self.{part}", f"{path}.{ours}.{part}")
        yield from linear(f"{source}.encoder.{theirs}.output.dense", f"{path}.{ours}.out")
        yield from layer_norm(f"{source}.encoder.{theirs}.output.LayerNorm", f"{path}.norms.{n}")
    for theirs, ours in (("self", "queries"), ("cross", "basis")):
        yield from _vector_rows(
            f"{source}.encoder.vec_attn.query_{theirs}_attn", f"{path}.vector_attention.{ours}"
        )
    if moves:
        yield from linear(f"{source}.encoder.vec_attn.reg_branch.0", f"{path}.branch.hidden")
        yield from linear(f"{source}.encoder.vec_attn.reg_branch.2", f"{path}.branch.offset")
    if not (is_last and moves):
        yield from linear(f"{source}.encoder.intermediate.dense", f"{path}.feed_forward.hidden")
        yield from linear(f"{source}.encoder.output.dense", f"{path}.feed_forward.out")
        yield from layer_norm(f"{source}.encoder.output.LayerNorm", f"{path}.feed_forward.norm")


def _vector_rows(source: str, path: str) -> NameRows:
    yield from linear(f"{source}.fc1", f"{path}.before")
    yield from linear(f"{source}.fc2", f"{path}.after")
    for theirs, ours in (("w_qs", "alpha"), ("w_ks", "beta"), ("w_vs", "psi")):
        yield from linear(f"{source}.{theirs}", f"{path}.attention.{ours}", bias=False)
    for theirs, ours in (("fc_gamma", "gamma"), ("fc_delta", "xi")):
        yield from linear(f"{source}.{theirs}.0", f"{path}.attention.{ours}_in")
        yield from linear(f"{source}.{theirs}.2", f"{path}.attention.{ours}_out")


def hand_prefixes(config: Config) -> dict[str, bool]:
    """Return the prefixes of the buffers `th_*` that hold a MANO asset, and whether an output uses them."""
    prefixes = {"mano_layer.": False, f"{HEAD}mano_layer.": True}
    if is_parametric(config):
        last = config.decoder.num_layers - 1
        prefixes |= {f"{_BLOCKS}{i}.mano_layer.": i == last for i in range(last + 1)}
    return prefixes


def unused_shapes(config: Config) -> dict[str, tuple[int, ...]]:
    """Return name and shape of every array that no output depends on, but for the hand's buffers."""
    shapes = dict(_unused_trunk(config))
    shapes |= dict(_unused_head(config.width))
    last = config.decoder.num_layers - 1
    for i in range(last + 1):
        shapes |= dict(_unused_layer(i, config, is_last=i == last))
    norms = [e.source for e in used_rows(config) if e.source.endswith(".running_mean")]
    norms += [name for name in shapes if name.endswith(".running_mean")]
    return shapes | {name.replace("running_mean", "num_batches_tracked"): () for name in norms}


def _unused_trunk(config: Config) -> Shapes:
    """The classification head of HRNet, and a branch that would read the heat maps."""
    assert isinstance(config.backbone, HRNetConfig)
    channels, inner = config.backbone.channels, (32, 64, 128, 256)
    for i, (c, middle) in enumerate(zip(channels, inner, strict=True)):
        block, wide = f"{TRUNK}incre_modules.{i}.0", 4 * middle
        for name, shape in (
            ("1", (middle, c, 1, 1)),
            ("2", (middle, middle, 3, 3)),
            ("3", (wide, middle, 1, 1)),
        ):
            yield f"{block}.conv{name}.weight", shape
            yield from _norm(f"{block}.bn{name}", shape[0])
        yield f"{block}.downsample.0.weight", (wide, c, 1, 1)
        yield from _norm(f"{block}.downsample.1", wide)
    for i, middle in enumerate(inner[1:]):
        yield from _layer(f"{TRUNK}downsamp_modules.{i}.0", (4 * middle, 2 * middle, 3, 3))
        yield from _norm(f"{TRUNK}downsamp_modules.{i}.1", 4 * middle)
    yield from _layer(f"{TRUNK}final_layer.0", (2048, 1024, 1, 1))
    yield from _norm(f"{TRUNK}final_layer.1", 2048)
    yield from _layer(f"{TRUNK}classifier", (1000, 2048))
    yield from _layer("uv_in.conv", (channels[1], NUM_JOINTS, 1, 1))
    yield from _norm("uv_in.norm", channels[1])


def _unused_head(width: int) -> Shapes:
    half = width // 2
    networks = {
        "center_shift_layer": ((NUM_QUERIES, NUM_QUERIES), (1, NUM_QUERIES)),
        "position_encoder": ((2 * width, _DEPTH_NUMBERS, 1, 1), (width, 2 * width, 1, 1)),
        "query_embedding": ((width, width), (width, width)),
        "merge_net_query_feature.0": ((width, width), (half, width)),
        "merge_net_query_feature.1": ((half, half), (width, half)),
    }
    networks |= {f"reg_branches.{i}": ((width, width), (3, width)) for i in range(3)}
    for name, (first, second) in networks.items():
        yield from _layer(f"{HEAD}{name}.0", first)
        yield from _layer(f"{HEAD}{name}.2", second)
    yield f"{HEAD}reference_embed.weight", (NUM_QUERIES, width)
    yield from _layer(f"{HEAD}layer_global_feat", (width, _GLOBAL_NUMBERS))


def _unused_layer(i: int, config: Config, *, is_last: bool) -> Shapes:
    source, width = f"{_BLOCKS}{i}", config.width
    for name, rows in (("word", _WORDS), ("position", _POSITIONS), ("token_type", _TYPES)):
        yield f"{source}.embeddings.{name}_embeddings.weight", (rows, width)
    yield from _layer(f"{source}.embeddings.LayerNorm", (width,))
    yield from _layer(f"{source}.pooler.dense", (width, width))
    yield f"{source}.position_embeddings.weight", (_POSITIONS, width)
    if is_parametric(config) and not is_last:
        yield from _layer(f"{source}.flat_verts", (1, NUM_QUERIES))
        yield from _layer(f"{source}.mano_linear", (_HAND_NUMBERS, width))
    if is_parametric(config) and is_last:
        yield from _layer(f"{source}.encoder.vec_attn.reg_branch.0", (width, width))
        yield from _layer(f"{source}.encoder.vec_attn.reg_branch.2", (3, width))
    if is_last and not is_parametric(config):
        hidden = config.decoder.ffn_expansion * width
        yield from _layer(f"{source}.encoder.intermediate.dense", (hidden, width))
        yield from _layer(f"{source}.encoder.output.dense", (width, hidden))
        yield from _layer(f"{source}.encoder.output.LayerNorm", (width,))


def _layer(source: str, shape: tuple[int, ...]) -> Shapes:
    yield f"{source}.weight", shape
    yield f"{source}.bias", shape[:1]


def _norm(source: str, channels: int) -> Shapes:
    for name in ("weight", "bias", "running_mean", "running_var"):
        yield f"{source}.{name}", (channels,)
