"""Names of the released POEM v1 and its ablations: the arrays that matter, and those that no output depends
on.

`used_rows` and `unused_shapes` together are the whole state dict, but for the buffers that hold the MANO
asset (`hand_prefixes`).
"""

from collections.abc import Iterator

from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES
from poem_jax.models.poem_v1_config import BasisFeatures, PoemV1Config, PointDecoderConfig, QueryEmbedding
from poem_jax.weights.name_table import Axes, NameRow, NameRows, conv_norm, convolution, linear
from poem_jax.weights.trunk_keys import resnet_rows

TRUNK = "img_backbone."
HEAD = "ptEmb_head."
_TRANSFORMER = f"{HEAD}transformer."
_CLASSES = 1000
"""Of ImageNet: the trunk keeps its classifier."""

Shapes = Iterator[tuple[str, tuple[int, ...]]]

_GLOBAL = (QueryEmbedding.GLOBAL, QueryEmbedding.GLOBAL_AND_VERTEX)
_WITH_TEMPLATE = (QueryEmbedding.GLOBAL, QueryEmbedding.POINTS, QueryEmbedding.POINT_CODES)


def used_rows(config: PoemV1Config) -> NameRows:
    """List the arrays that the forward pass uses."""
    assert isinstance(config.decoder, PointDecoderConfig)
    yield from resnet_rows(config.backbone, TRUNK)
    for i in range(len(config.backbone.channels) - 1):
        for theirs, ours in (("uv", "heat_maps"), ("feat", "features")):
            source = f"{theirs}_delayer.{i}"
            yield from conv_norm(f"{source}.conv", f"{source}.norm", f"{ours}.branch.merges.{i}", bias=True)
    yield from convolution("uv_out.conv", "heat_maps.to_logits")
    yield from convolution("feat_in.conv", "features.squeeze")
    yield from convolution(f"{HEAD}input_proj", "features.project")
    yield from linear("linear_inv_skin", "start.mesh")
    yield from linear(f"{HEAD}center_shift_layer.0", "start.shift_hidden")
    yield from linear(f"{HEAD}center_shift_layer.2", "start.shift")
    yield from convolution(f"{HEAD}position_encoder.0", "second.position_code.hidden")
    yield from convolution(f"{HEAD}position_encoder.2", "second.position_code.out")
    yield from convolution(f"{HEAD}adapt_pos3d", "second.position_code.view_row_column.mix")
    yield from _basis_rows(config)
    yield from _embedding_rows(config.query_embedding)
    yield from _vector_rows(f"{_TRANSFORMER}feats_self_attn", "second.decoder.among_basis")
    for i in range(config.decoder.num_layers):
        path = f"second.decoder.layers.{i}"
        yield from _vector_rows(f"{_TRANSFORMER}query_self_attn.{i}", f"{path}.queries")
        yield from _vector_rows(f"{_TRANSFORMER}query_feats_cross_attn.{i}", f"{path}.basis")
        yield from linear(f"{HEAD}reg_branches.{i}.0", f"{path}.branch.hidden")
        yield from linear(f"{HEAD}reg_branches.{i}.2", f"{path}.branch.offset")


def _basis_rows(config: PoemV1Config) -> NameRows:
    if config.basis_features is BasisFeatures.OWN_CAMERA:
        yield from linear(f"{HEAD}transition_up", "second.basis.enlarge")
        return
    for theirs, ours in (("feature", "basis"), ("query_feature", "queries")):
        for i, network in enumerate(("theta", "phi")):
            source, path = f"{HEAD}merge_net_{theirs}.{i}", f"second.basis.fuse_{ours}.{network}"
            yield from linear(f"{source}.0", f"{path}_in")
            yield from linear(f"{source}.2", f"{path}_out")


def _embedding_rows(kind: QueryEmbedding) -> NameRows:
    yield from linear(f"{HEAD}query_embedding.0", "second.embedding.hidden")
    yield from linear(f"{HEAD}query_embedding.2", "second.embedding.out")
    if kind in _GLOBAL:
        yield from linear(f"{HEAD}layer_global_feat", "second.embedding.to_global")
    if kind is not QueryEmbedding.GLOBAL:
        yield NameRow(f"{HEAD}reference_embed.weight", "trainable.second.embedding.table", Axes.SAME)


def _vector_rows(source: str, path: str) -> NameRows:
    yield from linear(f"{source}.fc1", f"{path}.before")
    yield from linear(f"{source}.fc2", f"{path}.after")
    for theirs, ours in (("w_qs", "alpha"), ("w_ks", "beta"), ("w_vs", "psi")):
        yield from linear(f"{source}.{theirs}", f"{path}.attention.{ours}", bias=False)
    for theirs, ours in (("fc_gamma", "gamma"), ("fc_delta", "xi")):
        yield from linear(f"{source}.{theirs}.0", f"{path}.attention.{ours}_in")
        yield from linear(f"{source}.{theirs}.2", f"{path}.attention.{ours}_out")


def hand_prefixes(config: PoemV1Config) -> dict[str, bool]:
    """Return the prefix of the buffers `th_*` that hold a MANO asset, and whether an output uses them."""
    return {"mano_layer.": config.query_embedding in _WITH_TEMPLATE}


def unused_shapes(config: PoemV1Config) -> Shapes:
    """List name and shape of every array that no output depends on, but for the hand's buffers."""
    coarsest, width = config.backbone.channels[-1], config.width
    yield from _layer(f"{TRUNK}fc", (_CLASSES, coarsest))
    yield from _layer("uv_in.conv", (width // 2, NUM_JOINTS, 1, 1))
    for name in ("weight", "bias", "running_mean", "running_var"):
        yield f"uv_in.norm.{name}", (width // 2,)
    if config.query_embedding is QueryEmbedding.GLOBAL:
        yield f"{HEAD}reference_embed.weight", (NUM_QUERIES, width)
    elif config.query_embedding is not QueryEmbedding.GLOBAL_AND_VERTEX and (
        config.basis_features is BasisFeatures.PROJECTED
    ):
        yield from _layer(f"{HEAD}layer_global_feat", (width, coarsest))
    yield "uv_in.norm.num_batches_tracked", ()
    for row in used_rows(config):
        # Frozen norms, all of which is among the statistics, count no batches.
        norm, _, part = row.source.rpartition(".")
        if part == "weight" and row.path.startswith("trainable.") and row.path.endswith(".norm.scale"):
            yield f"{norm}.num_batches_tracked", ()


def _layer(source: str, shape: tuple[int, ...]) -> Shapes:
    yield f"{source}.weight", shape
    yield f"{source}.bias", shape[:1]
