"""The paper's model as a whole: HRNet trunk and second stage, in inference and in training."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.models.apply import apply
from poem_jax.models.network import forward


def test_inference_uses_the_images(hrnet_config, make_params, make_scene):
    params = make_params(hrnet_config)
    (views, cams), (others, _) = (make_scene(1, 2, seed) for seed in (0, 1))
    first, second = (apply(params, images, cams, config=hrnet_config) for images in (views, others))
    assert first.vertices_world.shape == (1, 778, 3)
    assert first.keypoints_px.shape == (1, 2, 1, 2)
    assert first.valid.all()
    assert all(np.isfinite(leaf).all() for leaf in (first.layers_world, first.keypoints_px))
    assert np.abs(first.keypoints_px - second.keypoints_px).max() > 1e-2
    offsets = [np.asarray(p.layers_world) - np.asarray(p.root_world)[:, None, None] for p in (first, second)]
    assert np.abs(offsets[0] - offsets[1]).max() > 1e-4


@pytest.fixture
def gradients_and_statistics(hrnet_config, make_params, make_scene):
    """One step's worth of a loss on both stages, in training mode; compiled without optimisation."""
    params = make_params(hrnet_config)
    views, cams = make_scene(2, 2)

    def loss(trainable):
        prediction, statistics = forward(
            {**params, "trainable": trainable}, views, cams, config=hrnet_config, train=True
        )
        return jnp.sum(prediction.layers_world**2) + jnp.sum(prediction.keypoints_px), statistics

    lowered = jax.jit(jax.grad(loss, has_aux=True)).lower(params["trainable"])
    quick = lowered.compile(compiler_options={"xla_backend_optimization_level": 0})
    return quick(params["trainable"])


def test_training_reaches_every_weight_that_has_a_reader(gradients_and_statistics, hrnet_config, make_params):
    gradients, statistics = gradients_and_statistics
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    dead = [p for p, leaf in jax.tree_util.tree_leaves_with_path(gradients) if not np.any(leaf)]
    # The finest map, of stride 4, is read by nothing: the last exchange towards it learns nothing.
    unread = ".trunk.stage4.blocks.fuse.0."
    names = ["." + jax.tree_util.keystr(path, simple=True, separator=".") for path in dead]
    assert names
    assert all(name.startswith(unread) for name in names)
    before = make_params(hrnet_config)["statistics"]
    moved = jax.tree.map(lambda a, b: not np.allclose(a, b), statistics, before)
    assert all(jax.tree.leaves(moved))
