"""The named models.

`v2-small`, `v2-base`, `v2-large`, `v2-param` are the paper's; `v2-small-release`, `v2-medium-release`,
`v2-large-release`, `v2-medium-mano-release` those that the authors released, for their weights; `v2-nano` is
the paper's structure (the template first, sigmoid maps of the release's 21 joints, nearest points anew in
every layer, the primary view's similarities) on a small trunk; `tiny`, on the same trunk, is ours, for a CPU.

`v1` and its ablations `v1-1stage`, `v1-wo-proj`, `v1-wo-pt`, `v1-g-emb`, `v1-gv-emb`, and the baselines
`pe-meshtr`, `ftl-meshtr` and `mvp` are the paper's. The authors released `v1-release-dexycb` and so on, of
three data sets, and `pe-meshtr-release`, `ftl-meshtr-release`, `mvp-release`, here of DexYCB; `released`
gives every released model of every data set.
"""

from collections.abc import Callable
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
    FrozenNorms,
    HeatActivation,
    JointDecoderConfig,
    ModelConfig,
    ResNetConfig,
    RootConfig,
    Similarity,
    Stem,
    ViewWeights,
)
from poem_jax.models.frustum_config import CUBOIDS
from poem_jax.models.mesh_transformer_config import (
    FTL_MESHTR,
    PE_MESHTR,
    ftl_meshtr_release,
    pe_meshtr_release,
)
from poem_jax.models.mvp_config import MvpConfig
from poem_jax.models.poem_v1_config import (
    V1,
    BasisFeatures,
    OneStageConfig,
    PoemV1Config,
    QueryEmbedding,
    TokenDecoderConfig,
)
from poem_jax.models.poem_v1_config import one_stage as v1_one_stage
from poem_jax.models.poem_v1_config import released as released_v1

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
    joint_decoder=JointDecoderConfig(num_layers=3),
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

DATASETS = tuple(CUBOIDS)
RELEASED_VIEWS = {"dexycb": 8, "ho3d": 5, "oakink": 4}
"""Cameras of these data sets, which the layers of a released MvP are made for."""
_RELEASED_EMBEDDINGS = {
    "v1": QueryEmbedding.VERTEX,
    "v1-g-emb": QueryEmbedding.GLOBAL,
    "v1-gv-emb": QueryEmbedding.GLOBAL_AND_VERTEX,
    "v1-full-emb": QueryEmbedding.POINTS,
}


def _released_mvp(dataset: str, num_views: int) -> MvpConfig:
    trunk = ResNetConfig.resnet34(FrozenNorms.STAGE_STARTS)
    return MvpConfig(design=Design.RELEASE, num_views=num_views, backbone=trunk, cuboid=CUBOIDS[dataset])


def _released_v1(embedding: QueryEmbedding) -> Callable[[str, int], PoemV1Config]:
    return lambda dataset, num_views: released_v1(CUBOIDS[dataset], embedding)


def _released_v2(variant: str) -> Callable[[str, int], ModelConfig]:
    return lambda dataset, num_views: preset(f"{variant}-release")


RELEASED: dict[str, Callable[[str, int], ModelConfig]] = {
    **{name: _released_v2(name) for name in ("v2-small", "v2-medium", "v2-large", "v2-medium-mano")},
    **{name: _released_v1(embedding) for name, embedding in _RELEASED_EMBEDDINGS.items()},
    "v1-wo-proj": lambda dataset, num_views: released_v1(
        CUBOIDS[dataset], QueryEmbedding.POINT_CODES, BasisFeatures.OWN_CAMERA
    ),
    "pe-meshtr": lambda dataset, num_views: pe_meshtr_release(dataset),
    "ftl-meshtr": lambda dataset, num_views: ftl_meshtr_release(dataset),
    "mvp": _released_mvp,
}
"""How to make the config of each released model, of a data set and a number of views."""

PRESETS: dict[str, ModelConfig] = {
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
    "v1": V1,
    "v1-1stage": v1_one_stage(OneStageConfig().origin),
    "v1-wo-proj": replace(V1, basis_features=BasisFeatures.OWN_CAMERA),
    "v1-wo-pt": replace(V1, decoder=TokenDecoderConfig()),
    "v1-g-emb": replace(V1, query_embedding=QueryEmbedding.GLOBAL),
    "v1-gv-emb": replace(V1, query_embedding=QueryEmbedding.GLOBAL_AND_VERTEX),
    **{f"v1-release-{dataset}": released_v1(cuboid) for dataset, cuboid in CUBOIDS.items()},
    "pe-meshtr": PE_MESHTR,
    "pe-meshtr-release": pe_meshtr_release(),
    "ftl-meshtr": FTL_MESHTR,
    "ftl-meshtr-release": ftl_meshtr_release(),
    "mvp": MvpConfig(),
    "mvp-release": _released_mvp("dexycb", 8),
}


def preset(name: str) -> ModelConfig:
    """Return the configuration of a named model.

    Raises:
        ValueError: no model of that name.
    """
    if name not in PRESETS:
        raise ValueError(f"`name` must be one of {sorted(PRESETS)}; got {name!r}")
    return PRESETS[name]


def released(variant: str, *, dataset: str = "dexycb", num_views: int | None = None) -> ModelConfig:
    """Return the configuration of a released model.

    Args:
        variant: one of `RELEASED`.
        dataset: one of `DATASETS`: of POEM v1 and the baselines, what it was trained on; of no account for
            POEM v2.
        num_views: views that the layers of MvP are made for, None = the data set's (`RELEASED_VIEWS`); of no
            account for the others.

    Raises:
        ValueError: no such variant or data set.
    """
    if variant not in RELEASED:
        raise ValueError(f"`variant` must be one of {', '.join(RELEASED)}; got {variant!r}")
    if dataset not in DATASETS:
        raise ValueError(f"`dataset` must be one of {', '.join(DATASETS)}; got {dataset!r}")
    return RELEASED[variant](dataset, RELEASED_VIEWS[dataset] if num_views is None else num_views)
