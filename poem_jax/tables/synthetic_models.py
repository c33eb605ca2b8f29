"""The systems of the synthetic table, small and alike: one trunk, one width, one depth of decoder.

Trunk, crop and first stage are those of the shipped model. Where a system has a frustum grid or a cuboid, it
is of the size that the table's rigs need. Nothing is dropped in training, for no sample comes twice.
"""

from dataclasses import replace

from poem_jax.models.config import (
    AggregationConfig,
    BasisConfig,
    Config,
    DecoderConfig,
    Design,
    ModelConfig,
    ResNetConfig,
)
from poem_jax.models.detr_config import DetrConfig
from poem_jax.models.frustum_config import Cuboid, DepthSteps, FrustumConfig
from poem_jax.models.mesh_transformer_config import (
    CanonicalFusion,
    MeshTransformerConfig,
    PositionEmbeddedFusion,
)
from poem_jax.models.mvp_config import MvpConfig, MvpDecoderConfig
from poem_jax.models.poem_v1_config import (
    BallConfig,
    BasisFeatures,
    OneStageConfig,
    PoemV1Config,
    PointDecoderConfig,
    QueryEmbedding,
    TokenDecoderConfig,
)
from poem_jax.models.presets import TINY

_WIDTH, _LAYERS, _HEADS, _BASIS, _NEIGHBOURS = 64, 2, 2, 512, 8
_CUBOID = Cuboid((-0.4, -0.4, 0.4), (0.4, 0.4, 1.4))
"""Where hands are before the first camera of any of the rigs."""
_MEAN_ROOT = (0.0, 0.0, 0.92)
"""Before the first camera of the rig that is trained on."""
_TRUNK = TINY.backbone
assert isinstance(_TRUNK, ResNetConfig)
_DETR = DetrConfig(num_layers=_LAYERS, num_heads=_HEADS, ffn_width=256, dropout=0.0)
_FRUSTUM = FrustumConfig(8, _CUBOID.low[2], _CUBOID.high[2], DepthSteps.LINEAR)

_V2 = Config(
    image_hw=TINY.image_hw,
    crop=TINY.crop,
    width=_WIDTH,
    backbone=_TRUNK,
    root=TINY.root,
    basis=BasisConfig(num_points=_BASIS),
    decoder=DecoderConfig(num_layers=_LAYERS, num_heads=_HEADS, num_neighbours=_NEIGHBOURS, ffn_expansion=2),
)
_V1 = PoemV1Config(
    image_hw=TINY.image_hw,
    crop=TINY.crop,
    width=_WIDTH,
    backbone=_TRUNK,
    first_stage=TINY.root,
    basis=BallConfig(_BASIS, frustum=_FRUSTUM),
    decoder=PointDecoderConfig(_LAYERS, _NEIGHBOURS, _HEADS, ffn_expansion=2),
)
_PE_MESHTR = MeshTransformerConfig(
    fusion=PositionEmbeddedFusion(_FRUSTUM),
    image_hw=TINY.image_hw,
    crop=TINY.crop,
    width=_WIDTH,
    backbone=_TRUNK,
    cuboid=_CUBOID,
    decoder=_DETR,
)

TABLE_MODELS: dict[str, ModelConfig] = {
    "v2": _V2,
    "v2-apart": _V2,
    "v2-row-major": replace(_V2, aggregation=AggregationConfig(design=Design.RELEASE)),
    "v1": _V1,
    "v1-1stage": replace(_V1, first_stage=OneStageConfig(_MEAN_ROOT), space=_CUBOID),
    "v1-wo-proj": replace(_V1, basis_features=BasisFeatures.OWN_CAMERA),
    "v1-wo-pt": replace(_V1, decoder=TokenDecoderConfig(_DETR, _CUBOID)),
    "v1-g-emb": replace(_V1, query_embedding=QueryEmbedding.GLOBAL),
    "v1-gv-emb": replace(_V1, query_embedding=QueryEmbedding.GLOBAL_AND_VERTEX),
    "pe-meshtr": _PE_MESHTR,
    "ftl-meshtr": replace(_PE_MESHTR, fusion=CanonicalFusion(num_points=16, num_views=8)),
    "mvp": MvpConfig(
        num_views=8,
        image_hw=TINY.image_hw,
        crop=TINY.crop,
        width=_WIDTH,
        backbone=_TRUNK,
        cuboid=_CUBOID,
        decoder=MvpDecoderConfig(_LAYERS, num_heads=_HEADS, ffn_expansion=2, dropout=0.0),
    ),
}
"""`v2-apart` begins with query vectors drawn each for itself (`RunConfig.smooth_queries`). `v2-row-major`
fuses views as the release does: it reads its samples in another order than they lie in memory, which mixes
them (`AggregationConfig.design`)."""
