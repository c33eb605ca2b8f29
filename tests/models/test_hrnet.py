import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from poem_jax.models.backbones import BasicBlock, HRNet, Stack
from poem_jax.models.config import HRNetConfig
from poem_jax.models.layers import NormMode, TrunkRow, recompute


def test_the_papers_trunk_has_the_published_size():
    """45,521,216 live entries of the released trunk: weights, and mean and variance of every batch norm."""
    model = nnx.eval_shape(lambda: HRNet(HRNetConfig(40), rngs=nnx.Rngs(0)))
    sizes = [leaf.size for leaf in jax.tree.leaves(nnx.state(model, nnx.Param))]
    assert sum(sizes) == 45_521_216


@pytest.mark.parametrize("width", [4, 18, 40])
def test_levels_of_any_width(width):
    config = HRNetConfig(width)
    images = jax.ShapeDtypeStruct((2, 64, 96, 3), jnp.float32)
    levels = jax.eval_shape(lambda x: HRNet(config, rngs=nnx.Rngs(0))(x, NormMode()), images)
    assert [x.shape for x in levels] == [
        (2, 64 // s, 96 // s, c) for s, c in zip(config.strides, config.channels, strict=True)
    ]


@pytest.fixture
def stack():
    return Stack(lambda rngs: BasicBlock(4, 4, rngs=rngs), 3, rngs=nnx.Rngs(0))


X = np.random.default_rng(0).normal(size=(2, 6, 6, 4)).astype(np.float32)


@pytest.mark.parametrize("mode", [NormMode(), NormMode(np.array([True, False]))])
def test_loop_and_unrolled_blocks_agree(stack, mode):
    graph, weights = nnx.split(stack)
    looped, unrolled = nnx.merge(graph, weights), nnx.merge(graph, weights)
    np.testing.assert_allclose(looped.scanned(X, mode), unrolled.unrolled(X, mode), atol=1e-5)
    for a, b in zip(jax.tree.leaves(nnx.state(looped)), jax.tree.leaves(nnx.state(unrolled)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_loop_and_unrolled_blocks_have_the_same_gradients(stack):
    """Of images and weights, in training; also where the loop computes its insides again."""
    graph, weights = nnx.split(stack)

    def gradients(run, recomputed=()):
        def loss(weights, x):
            stack = nnx.merge(graph, weights)
            recompute(stack, recomputed)
            return jnp.sum(run(stack, x, NormMode(np.ones(2, bool))) ** 2)

        return jax.tree.leaves(jax.jit(jax.grad(loss, argnums=(0, 1)))(weights, X))

    unrolled = gradients(Stack.unrolled)
    for looped in (gradients(Stack.scanned), gradients(Stack.scanned, (TrunkRow,))):
        for a, b in zip(looped, unrolled, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * np.abs(b).max())
    assert np.any(unrolled[-1])


def test_blocks_of_a_stack_differ(stack):
    kernels = stack.blocks.first.conv.kernel[...]
    assert kernels.shape[0] == 3
    assert not np.allclose(kernels[0], kernels[1])


@pytest.mark.slow
def test_training_and_inference_run():
    config = HRNetConfig(4, stem_channels=4, stem_blocks=2, modules=(1, 1, 1), blocks=1)
    images = np.random.default_rng(0).normal(size=(2, 32, 32, 3)).astype(np.float32)

    @jax.jit
    def run(images):
        model = HRNet(config, rngs=nnx.Rngs(0))
        levels = model(images, NormMode()), model(images, NormMode(jnp.ones(2, bool)))
        return levels, nnx.to_pure_dict(nnx.state(model, nnx.BatchStat))

    (*levels,), statistics = run(images)
    for maps in levels:
        assert [x.shape for x in maps] == [(2, 8, 8, 4), (2, 4, 4, 8), (2, 2, 2, 16), (2, 1, 1, 32)]
        assert all(np.isfinite(x).all() for x in maps)
    assert not any(np.isin(leaf, (0, 1)).all() for leaf in jax.tree.leaves(statistics))
