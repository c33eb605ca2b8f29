from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models.backbones import ResNet
from poem_jax.models.config import FrozenNorms, ResNetConfig, Stem
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


def test_frozen_norms_are_neither_trained_nor_moved():
    """Of the stem and of the first block of every stage, as the v1 release has them."""
    config = ResNetConfig(
        (2, 2), (4, 8), bottleneck=False, stem_channels=4, frozen_norms=FrozenNorms.STAGE_STARTS
    )
    model = ResNet(config, rngs=nnx.Rngs(0))
    before = dict(nnx.to_flat_state(nnx.state(model, nnx.BatchStat)))
    before = {path: np.asarray(leaf.get_value()) for path, leaf in before.items()}
    model(jax.random.uniform(jax.random.key(0), (2, 16, 16, 3)), NormMode(jnp.ones(2, bool)))
    after = dict(nnx.to_flat_state(nnx.state(model, nnx.BatchStat)))
    moved = {path for path, leaf in after.items() if not np.array_equal(leaf.get_value(), before[path])}
    kept = {path[:-2] for path in after if path not in moved}
    first_blocks = {("stages", i, "blocks", 0, part) for i in (0, 1) for part in ("first", "second")}
    assert kept == {("stem", "conv"), ("stages", 1, "blocks", 0, "shortcut"), *first_blocks}
    trained = {path[:-2] for path, _ in nnx.to_flat_state(nnx.state(model, nnx.Param)) if "norm" in path}
    assert trained == {path[:-2] for path in moved}


def test_frozen_norms_are_ordinary_ones_at_inference():
    free = ResNetConfig((1,), (4,), bottleneck=False, stem_channels=4)
    frozen = replace(free, frozen_norms=FrozenNorms.STAGE_STARTS)
    images = jax.random.uniform(jax.random.key(0), (2, 16, 16, 3))
    levels = [ResNet(c, rngs=nnx.Rngs(0))(images, NormMode())[0] for c in (free, frozen)]
    np.testing.assert_array_equal(*levels)
