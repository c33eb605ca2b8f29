"""A model that compiles in seconds and is too small to be good; tests vary it by `replace`."""

from poem_jax.models.config import BasisConfig, Config, DecoderConfig, ResNetConfig, Stem

MICRO = Config(
    image_hw=(32, 32),
    width=16,
    backbone=ResNetConfig(
        blocks=(1, 1), channels=(8, 16), bottleneck=False, stem=Stem.SPACE_TO_DEPTH, stem_channels=8
    ),
    basis=BasisConfig(num_points=64),
    decoder=DecoderConfig(num_layers=1, num_neighbours=4, ffn_expansion=1),
)
