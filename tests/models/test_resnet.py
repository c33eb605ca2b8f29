import jax
import jax.numpy as jnp
import pytest
from flax import nnx

from poem_jax.models.backbones import ResNet
from poem_jax.models.config import ResNetConfig, Stem
from poem_jax.models.layers import NormMode


def _abstract(config: ResNetConfig, hw: int):
    def run(images):
        return ResNet(config, rngs=nnx.Rngs(0))(images, NormMode())

    model = nnx.eval_shape(lambda: ResNet(config, rngs=nnx.Rngs(0)))
    count = sum(leaf.size for leaf in jax.tree.leaves(nnx.state(model, nnx.Param)))
    return jax.eval_shape(run, jax.ShapeDtypeStruct((2, hw, hw, 3), jnp.float32)), count


@pytest.mark.parametrize(
    ("config", "count"),
    [
        (ResNetConfig.resnet18(), 11_176_512),
        (ResNetConfig.resnet34(), 21_284_672),
        (ResNetConfig.resnet50(), 23_508_032),
    ],
)
def test_published_networks(config, count):
    """Parameter counts are those of the published networks without their classifier."""
    levels, found = _abstract(config, 64)
    assert found == count
    assert [x.shape for x in levels] == [
        (2, 64 // s, 64 // s, c) for s, c in zip(config.strides, config.channels, strict=True)
    ]


def test_space_to_depth_stem_sees_all_pixels():
    config = ResNetConfig((1,), (4,), bottleneck=False, stem=Stem.SPACE_TO_DEPTH, stem_channels=4)
    model = ResNet(config, rngs=nnx.Rngs(0))

    def total(images):
        return jnp.sum(model(images, NormMode())[0] ** 2)

    gradient = jax.jit(jax.grad(total))(jax.random.uniform(jax.random.key(0), (1, 8, 8, 3)))
    assert (gradient != 0).all()
