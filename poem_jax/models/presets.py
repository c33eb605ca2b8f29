"""The named models: `v2-small`, `v2-base`, `v2-large`, `v2-param` of the paper, and `tiny` for a CPU."""

from dataclasses import replace

from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.models.config import (
    BasisConfig,
    Config,
    DecoderConfig,
    DecoderOutput,
    HeatActivation,
    NeighbourSearch,
    QueryStart,
    ResNetConfig,
    RootConfig,
    Similarity,
    Stem,
    ViewWeights,
)

V2_BASE = Config()
V2_SMALL = replace(V2_BASE, width=128)
V2_LARGE = replace(V2_BASE, width=512)
V2_PARAM = replace(V2_BASE, decoder=DecoderConfig(output=DecoderOutput.HAND_PARAMETERS))

TINY = Config(
    image_hw=(128, 128),
    width=64,
    backbone=ResNetConfig(
        blocks=(1, 2, 3, 2),
        channels=(32, 64, 128, 256),
        bottleneck=False,
        stem=Stem.SPACE_TO_DEPTH,
        stem_channels=32,
    ),
    root=RootConfig(
        num_joints=NUM_JOINTS,
        activation=HeatActivation.SOFTMAX,
        view_weights=ViewWeights.HEAT_SPREAD,
    ),
    basis=BasisConfig(num_points=1024),
    similarity=Similarity.MEAN,
    decoder=DecoderConfig(
        num_layers=2,
        num_neighbours=8,
        ffn_expansion=2,
        query_start=QueryStart.JOINTS,
        neighbour_search=NeighbourSearch.ONCE,
        cross_attention_basis_stride=4,
        embed_coordinates=True,
    ),
)

PRESETS = {
    "v2-small": V2_SMALL,
    "v2-base": V2_BASE,
    "v2-large": V2_LARGE,
    "v2-param": V2_PARAM,
    "tiny": TINY,
}


def preset(name: str) -> Config:
    """Return the configuration of a named model.

    Raises:
        ValueError: no model of that name.
    """
    if name not in PRESETS:
        raise ValueError(f"`name` must be one of {sorted(PRESETS)}; got {name!r}")
    return PRESETS[name]
