"""The named models.

`v2-small`, `v2-base`, `v2-large`, `v2-param` are the paper's; `v2-small-release`, `v2-medium-release`,
`v2-large-release`, `v2-medium-mano-release` those that the authors released, for their weights; `v2-nano` is
the paper's structure (the template first, sigmoid maps of the release's 21 joints, nearest points anew in
every layer, the primary view's similarities) on a small trunk; `tiny`, on the same trunk, is ours, for a CPU.
"""

from dataclasses import replace

from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.models.config import (
    AggregationConfig,
    BasisConfig,
    Config,
    CropConfig,
    DecoderConfig,
    DecoderOutput,
    Design,
    FeatureConfig,
    FirstQueries,
    HeatActivation,
    JointDecoderConfig,
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

V2_MEDIUM_RELEASE = Config(
    root=RootConfig(num_joints=NUM_JOINTS, design=Design.RELEASE),
    features=FeatureConfig(stride=16, design=Design.RELEASE),
    aggregation=AggregationConfig(design=Design.RELEASE),
    decoder=DecoderConfig(layer=Design.RELEASE, dropout=0.1),
)
V2_SMALL_RELEASE = replace(V2_MEDIUM_RELEASE, width=128)
V2_LARGE_RELEASE = replace(V2_MEDIUM_RELEASE, width=512)
V2_MEDIUM_MANO_RELEASE = replace(
    V2_MEDIUM_RELEASE,
    decoder=replace(V2_MEDIUM_RELEASE.decoder, output=DecoderOutput.HAND_PARAMETERS),
)

TINY = Config(
    image_hw=(128, 128),
    crop=CropConfig(ratio=1.5),
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
        stride=4,
        activation=HeatActivation.SOFTMAX,
        view_weights=ViewWeights.HEAT_SPREAD,
    ),
    features=FeatureConfig(stride=4, heat_maps=True),
    basis=BasisConfig(num_points=1024),
    aggregation=AggregationConfig(similarity=Similarity.EQUAL),
    joint_decoder=JointDecoderConfig(),
    decoder=DecoderConfig(
        num_layers=2,
        num_neighbours=8,
        ffn_expansion=2,
        first_queries=FirstQueries.JOINTS,
        cross_attention_basis_stride=4,
        embed_coordinates=True,
    ),
)

V2_NANO = Config(
    image_hw=TINY.image_hw,
    crop=TINY.crop,
    width=64,
    backbone=TINY.backbone,
    root=RootConfig(num_joints=NUM_JOINTS),
    basis=BasisConfig(num_points=2048),
)

PRESETS = {
    "v2-small": V2_SMALL,
    "v2-base": V2_BASE,
    "v2-large": V2_LARGE,
    "v2-param": V2_PARAM,
    "v2-small-release": V2_SMALL_RELEASE,
    "v2-medium-release": V2_MEDIUM_RELEASE,
    "v2-large-release": V2_LARGE_RELEASE,
    "v2-medium-mano-release": V2_MEDIUM_MANO_RELEASE,
    "v2-nano": V2_NANO,
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
