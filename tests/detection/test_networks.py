"""Both networks: shapes, independence of the images of a batch, and the stored weights."""

import jax
import numpy as np
import pytest

from poem_jax.detection import stored_weights
from poem_jax.detection.landmark_network import landmark_network, landmark_shapes
from poem_jax.detection.palm_network import palm_network, palm_shapes
from poem_jax.detection.stored_weights import landmark_weights, palm_weights, weight_names

PARAMETERS = {palm_shapes: 1_133_000, landmark_shapes: 2_716_000}
"""Of MediaPipe's two networks, to a thousand."""


@pytest.mark.parametrize("shapes", PARAMETERS)
def test_size_of_the_networks(shapes):
    count = sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(shapes()))
    # The head of points in metres (63 x 1153) is left out, and biases that are all zero are stored.
    unused = 63 * 1153 if shapes is landmark_shapes else 0
    assert count + unused == pytest.approx(PARAMETERS[shapes], rel=5e-3)


@pytest.mark.parametrize(
    ("network", "weights", "size"),
    [(palm_network, palm_weights, 192), (landmark_network, landmark_weights, 224)],
)
def test_a_picture_does_not_see_its_batch(network, weights, size):
    pictures = np.random.default_rng(0).random((2, size, size, 3), np.float32)
    run = jax.jit(network)
    together = run(weights(), pictures)
    alone = run(weights(), np.stack([pictures[1]] * 2))
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_allclose(np.asarray(a)[1], np.asarray(b)[0], rtol=1e-3, atol=1e-3)


def test_names_in_the_files_are_places_in_the_networks():
    assert "stages/4/mix/kernel" in weight_names(palm_shapes())
    assert "bottlenecks/15/filter/bias" in weight_names(landmark_shapes())


def test_a_file_of_other_shapes_is_refused(tmp_path):
    shapes = landmark_shapes()
    zeros = [np.zeros(leaf.shape, np.float16) for leaf in jax.tree.leaves(shapes)]
    arrays = dict(zip(weight_names(shapes), zeros, strict=True))
    arrays["points/bias"] = np.zeros(62, np.float16)
    np.savez(tmp_path / "landmarks.npz", **arrays)
    with pytest.raises(ValueError, match=r"`points/bias` in .*landmarks.npz must have shape \(63,\); got"):
        stored_weights._read(tmp_path / "landmarks.npz", shapes)


def test_the_notice_lies_beside_the_weights():
    text = (stored_weights.FOLDER / "NOTICE").read_text()
    assert "MediaPipe" in text
    assert "Apache License, Version 2.0" in text
