"""Whether a model is the system of a row: of its kind, and of the same ablation, whatever its size."""

from functools import singledispatch
from typing import Any

from poem_jax.models.config import Config, ModelConfig
from poem_jax.models.mesh_transformer_config import MeshTransformerConfig
from poem_jax.models.poem_v1_config import BasisFeatures, OneStageConfig, PoemV1Config, TokenDecoderConfig
from poem_jax.models.presets import preset

_V2_SIZES = ("v2-small", "v2-base", "v2-large")


def is_of_preset(config: ModelConfig, name: str) -> bool:
    """Tell whether a config, the paper's or the release's, is of a preset's system.

    The data set that a model of POEM v1 was trained on cannot be told from it.
    """
    wanted = preset(name)
    return type(config) is type(wanted) and _made_of(config) == _made_of(wanted) and _has_size(config, wanted)


@singledispatch
def _made_of(config: ModelConfig) -> tuple[Any, ...]:
    """Return what tells systems of one class from each other, paper's and release's alike."""
    return ()


@_made_of.register
def _(config: Config) -> tuple[Any, ...]:
    return (config.decoder.output,)


@_made_of.register
def _(config: MeshTransformerConfig) -> tuple[Any, ...]:
    return (type(config.fusion),)


@_made_of.register
def _(config: PoemV1Config) -> tuple[Any, ...]:
    own_camera = config.basis_features is BasisFeatures.OWN_CAMERA
    return (
        isinstance(config.first_stage, OneStageConfig),
        isinstance(config.decoder, TokenDecoderConfig),
        own_camera,
        # The release without projection has another embedding as well.
        None if own_camera else config.query_embedding,
    )


def _has_size(config: ModelConfig, wanted: ModelConfig) -> bool:
    """Of POEM v2's sizes one does not stand for another; a width that is none of them is somebody's own."""
    if not isinstance(config, Config) or not isinstance(wanted, Config):
        return True
    widths = {one.width for one in map(preset, _V2_SIZES) if isinstance(one, Config)}
    return config.width == wanted.width or config.width not in widths
