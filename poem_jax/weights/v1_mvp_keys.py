"""Names of the released MvP: the arrays that matter, and those that no output depends on.

`used_rows`, `constant_rows` and `unused_shapes` together are the whole state dict, but for the buffers that
hold the MANO asset (`hand_prefixes`).
"""

from collections.abc import Iterator

from poem_jax.models.mvp_config import NUM_LEVELS, MvpConfig
from poem_jax.weights.name_table import NameRow, NameRows, attention, conv_norm, layer_norm, linear
from poem_jax.weights.trunk_keys import resnet_rows

TRUNK = "img_backbone."
HEAD = "head."
_CLASSES = 1000
"""Of ImageNet."""
_POOLED = 512
"""Channels of the trunk's coarsest map."""
_FINEST = 128
_POINT_CODE = 384

Shapes = Iterator[tuple[str, tuple[int, ...]]]


def used_rows(config: MvpConfig) -> NameRows:
    """List the weights that the forward pass uses."""
    yield from resnet_rows(config.backbone, TRUNK)
    for i in range(NUM_LEVELS):
        source = f"{HEAD}feat_delayer.{i}"
        yield from conv_norm(f"{source}.conv", f"{source}.norm", f"reduce.{i}", bias=True)
    yield from linear(f"{HEAD}reference_feats", "queries.mix")
    yield from linear(f"{HEAD}reference_points", "queries.locate")
    yield NameRow(f"{HEAD}tgt_pose_embedding.weight", "trainable.queries.table")
    for i in range(config.decoder.num_layers):
        yield from _layer_rows(f"{HEAD}decoder.layers.{i}", f"layers.{i}")
        yield from linear(f"{HEAD}reg_branches.{i}.0", f"layers.{i}.branch.hidden")
        yield from linear(f"{HEAD}reg_branches.{i}.2", f"layers.{i}.branch.offset")


def _layer_rows(source: str, path: str) -> NameRows:
    yield from attention(f"{source}.self_attn", f"{path}.self_attention")
    for theirs, ours in (
        ("rayconv", "ray_mix"),
        ("sampling_offsets", "offsets"),
        ("attention_weights", "weights"),
        ("output_proj", "out"),
    ):
        yield from linear(f"{source}.proj_attn.{theirs}", f"{path}.projective_attention.{ours}")
    yield from linear(f"{source}.fuse_view_projction", f"{path}.fuse")
    yield from linear(f"{source}.linear1", f"{path}.hidden")
    yield from linear(f"{source}.linear2", f"{path}.out")
    # The release counts the norm after the views' attention first, which runs second.
    for theirs, ours in ((2, 0), (1, 1), (3, 2)):
        yield from layer_norm(f"{source}.norm{theirs}", f"{path}.norms.{ours}")
    yield from linear(f"{source}.linear_mano_1", f"{path}.hand.regress.hidden")
    yield from linear(f"{source}.linear_mano_2", f"{path}.hand.regress.out")
    yield from layer_norm(f"{source}.norm4", f"{path}.hand.norm")


def constant_rows(config: MvpConfig) -> NameRows:
    """List what the forward pass uses of the MANO asset beyond a hand model's own arrays."""
    yield NameRow(f"{HEAD}mano_layer.th_selected_comps", "constants.pose_components")


def hand_prefixes(config: MvpConfig) -> dict[str, bool]:
    """Return the prefixes of the buffers `th_*` that hold a MANO asset, and whether an output uses them."""
    return {f"{HEAD}mano_layer.": True, "mano_layer.": False}


def unused_shapes(config: MvpConfig) -> Shapes:
    """List name and shape of every array that no output depends on, but for the hand's buffers."""
    width = config.width
    yield from _layer(f"{TRUNK}fc", (_CLASSES, _POOLED))
    yield from _layer(f"{HEAD}input_proj", (width, _FINEST, 1, 1))
    yield from _layer(f"{HEAD}layer_global_feat", (width, _POOLED))
    yield from _layer(f"{HEAD}query_embedding.0", (width, _POINT_CODE + 3))
    yield from _layer(f"{HEAD}query_embedding.2", (3, width))
    rows = list(used_rows(config))
    trained = {row.source.removesuffix(".weight") for row in rows if row.path.startswith("trainable.")}
    for row in rows:
        norm, mean, _ = row.source.rpartition(".running_mean")
        if mean and norm in trained:
            # Frozen norms count no batches.
            yield f"{norm}.num_batches_tracked", ()


def _layer(source: str, shape: tuple[int, ...]) -> Shapes:
    yield f"{source}.weight", shape
    yield f"{source}.bias", shape[:1]
