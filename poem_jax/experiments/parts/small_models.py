"""Every model as thin as it gets: its design, one layer, a few channels, images of 32 x 32."""

import functools
from dataclasses import replace

from poem_jax.models.config import Config, Design, JointDecoderConfig, ModelConfig, ResNetConfig, Stem
from poem_jax.models.detr_config import DetrConfig
from poem_jax.models.frustum_config import Cuboid, FrustumConfig
from poem_jax.models.mesh_transformer_config import (
    CanonicalFusion,
    MeshTransformerConfig,
    PositionEmbeddedFusion,
)
from poem_jax.models.mvp_config import MvpConfig, MvpDecoderConfig
from poem_jax.models.poem_v1_config import (
    OneStageConfig,
    PoemV1Config,
    PointDecoderConfig,
    TokenDecoderConfig,
)

NUM_VIEWS = 3
"""What the layers are made for that are tied to a number of views."""
DISTANCE_M = 0.4
"""From the cameras to the hand, in the middle of what they see."""
_CUBOID = Cuboid((-0.4, -0.4, 0.1), (0.4, 0.4, 0.7))
_WIDTH, _HEADS, _NEIGHBOURS = 16, 2, 4
_DETR = DetrConfig(num_layers=1, num_heads=_HEADS, ffn_width=16)
_JOINT_DECODER = JointDecoderConfig(num_layers=1, width=8, num_heads=2, num_blocks=1, picked_features=2)


@functools.singledispatch
def small(config: ModelConfig) -> ModelConfig:
    """Return the same system with everything small that has a size."""
    raise NotImplementedError(f"say here how a {type(config).__name__} is made small")


def with_joint_decoder(config: Config) -> Config:
    """Return the model with a joint decoder, as thin as the rest."""
    return replace(config, joint_decoder=_JOINT_DECODER)


def _trunk(stages: int, like: ResNetConfig | None = None) -> ResNetConfig:
    frozen = {} if like is None else {"frozen_norms": like.frozen_norms}
    return ResNetConfig(
        (1,) * stages,
        (8, 8, 16)[-stages:],
        bottleneck=False,
        stem=Stem.SPACE_TO_DEPTH,
        stem_channels=8,
        **frozen,
    )


def _frustum(config: FrustumConfig, num_depths: int) -> FrustumConfig:
    return replace(config, num_depths=num_depths, start=DISTANCE_M - 0.1, end=DISTANCE_M + 0.15)


@small.register
def _(config: Config) -> Config:
    decoder = config.decoder
    by_release = decoder.layer is Design.RELEASE
    return replace(
        config,
        image_hw=(32, 32),
        width=_WIDTH,
        backbone=_trunk(2),
        features=replace(config.features, stride=4 if by_release else config.features.stride),
        basis=replace(config.basis, num_points=800 if by_release else 64),
        decoder=replace(decoder, num_layers=1, num_heads=_HEADS, num_neighbours=_NEIGHBOURS, ffn_expansion=1),
    )


@small.register
def _(config: PoemV1Config) -> PoemV1Config:
    decoder, first = config.decoder, config.first_stage
    return replace(
        config,
        image_hw=(32, 32),
        width=_WIDTH,
        backbone=_trunk(2, config.backbone),
        first_stage=OneStageConfig((0.0, 0.0, DISTANCE_M)) if isinstance(first, OneStageConfig) else first,
        space=_CUBOID if isinstance(config.space, Cuboid) else config.space,
        basis=replace(config.basis, num_points=32, frustum=_frustum(config.basis.frustum, 2)),
        decoder=TokenDecoderConfig(_DETR, _CUBOID)
        if isinstance(decoder, TokenDecoderConfig)
        else PointDecoderConfig(1, _NEIGHBOURS, _HEADS, ffn_expansion=1),
    )


@small.register
def _(config: MeshTransformerConfig) -> MeshTransformerConfig:
    fusion = config.fusion
    return replace(
        config,
        image_hw=(32, 32),
        width=_WIDTH,
        backbone=_trunk(2 if config.design is Design.RELEASE else 3, config.backbone),
        fusion=PositionEmbeddedFusion(_frustum(fusion.frustum, 2))
        if isinstance(fusion, PositionEmbeddedFusion)
        else CanonicalFusion(num_points=3, num_views=NUM_VIEWS),
        cuboid=_CUBOID,
        decoder=_DETR,
    )


@small.register
def _(config: MvpConfig) -> MvpConfig:
    return replace(
        config,
        num_views=NUM_VIEWS,
        image_hw=(32, 32),
        width=_WIDTH,
        backbone=_trunk(3, config.backbone),
        cuboid=_CUBOID,
        decoder=MvpDecoderConfig(1, _HEADS, num_points=2, ffn_expansion=1),
    )
