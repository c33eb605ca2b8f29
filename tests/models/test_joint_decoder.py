"""The joint decoder: what it reads, in which frame it moves, and that it learns to mend joints."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.transforms import rigid, rotation_from_axis_angle
from poem_jax.hand.model import template_queries
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT, QueryOrder, split_queries
from poem_jax.models.config import FirstQueries, Frozen, JointDecoderConfig
from poem_jax.models.decoder import JointDecoder, cloud, read_evidence
from poem_jax.models.network import forward
from poem_jax.models.point_features import evidence

HW, CELLS = (64, 64), 16
MICRO = JointDecoderConfig(num_layers=2, width=16, num_heads=2, num_blocks=1, picked_features=2)


def scene(seed: int, batch: int = 2, views: int = 3) -> tuple[np.ndarray, Cameras]:
    """Hands half a metre before cameras that stand all around them."""
    rng = np.random.default_rng(seed)
    joints = split_queries(
        template_queries(default_hand(), QueryOrder.VERTICES_FIRST), QueryOrder.VERTICES_FIRST
    )[1]
    R = rotation_from_axis_angle(rng.normal(size=(batch, views, 3)))
    K = np.array([[160.0, 0, 32], [0, 160, 32], [0, 0, 1]])
    cams = Cameras(
        np.tile(K, (batch, views, 1, 1)),
        rigid(R, np.tile([0, 0, 0.5], (batch, views, 1))),
        np.ones((batch, views), bool),
    )
    turn = rotation_from_axis_angle(rng.normal(size=(batch, 3)))
    hands = np.einsum("bij,kj->bki", turn, joints - joints[ROOT_JOINT])
    as_float32 = jax.tree.map(lambda a: a.astype(np.float32) if a.dtype == float else a, (hands, cams))
    return as_float32[0], Cameras(*as_float32[1])


def evidence_of(joints: np.ndarray, cams: Cameras, sigma_cells: float = 1.5) -> jax.Array:
    """What round heat maps about the joints say."""
    uv_px, _ = project(cams.K, cams.T_cam_from_world, joints[:, None])
    cells = jnp.arange(CELLS) + 0.5
    apart = [cells - uv_px[..., axis, None] * (CELLS / HW[0]) for axis in (0, 1)]
    logits = -0.5 * (apart[1][..., :, None] ** 2 + apart[0][..., None, :] ** 2) / sigma_cells**2
    maps = jax.nn.softmax(logits, axis=(-2, -1))
    said = evidence(maps.reshape(-1, *maps.shape[-3:]))
    return jnp.moveaxis(said, -1, -3).reshape(maps.shape)


@functools.partial(jax.jit, static_argnames="training")
def moved(
    decoder: JointDecoder, joints, said, maps, cams: Cameras, training: bool = False
) -> list[jax.Array]:
    return decoder(joints, said, maps, cams, HW, training=training)


@jax.jit
def read(said, cams: Cameras, clouds) -> jax.Array:
    return read_evidence(said, cams, clouds, HW)


def random_decoder(seed: int = 0, spread: float = 1.0) -> JointDecoder:
    decoder = JointDecoder(MICRO, 3, 0.1, rngs=nnx.Rngs(params=seed))
    rng = np.random.default_rng(seed)
    for layer in decoder.layers:
        layer.offset.kernel[...] = jnp.asarray(spread * rng.normal(size=(MICRO.width, 3)), jnp.float32)
    return decoder


def maps_of(cams: Cameras, seed: int = 0) -> np.ndarray:
    return (
        np.random.default_rng(seed).normal(size=(*cams.view_mask.shape, CELLS, CELLS, 3)).astype(np.float32)
    )


def test_a_cloud_is_centred_and_fills_its_shells() -> None:
    points = cloud((0.01, 0.02, 0.03))
    radii = np.linalg.norm(points, axis=-1)
    np.testing.assert_allclose(radii, [0] + 6 * [0.01] + 8 * [0.02] + 6 * [0.03], atol=1e-8)
    np.testing.assert_allclose(points.mean(0), 0, atol=1e-8)
    assert len(np.unique(points.round(6), axis=0)) == len(points)


def test_evidence_is_strongest_where_the_views_agree() -> None:
    """Of places 2 cm apart, which is more than a cell."""
    joints, cams = scene(1)
    said = evidence_of(joints, cams)
    offsets = 0.02 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    at = np.asarray(read(said, cams, joints[:, :, None] + np.float32(offsets)))
    assert (at.argmax(-1) == 0).all()


def test_evidence_is_the_mean_of_the_views_that_count() -> None:
    joints, cams = scene(2)
    said = evidence_of(joints, cams)
    clouds = joints[:, :, None] + np.float32(0.004)
    single = [read(said, cams._replace(view_mask=np.eye(3, dtype=bool)[[v, v]]), clouds) for v in range(3)]
    two = cams._replace(view_mask=np.array([[True, False, True]] * 2))
    np.testing.assert_allclose(read(said, two, clouds), (single[0] + single[2]) / 2, rtol=1e-5, atol=1e-5)


def test_nothing_is_said_behind_a_camera_and_outside_its_image() -> None:
    joints, cams = scene(3)
    said = jnp.ones((2, 3, NUM_JOINTS, CELLS, CELLS))
    centres = -np.einsum(
        "bvji,bvj->bvi", cams.T_cam_from_world[..., :3, :3], cams.T_cam_from_world[..., :3, 3]
    )
    behind = np.broadcast_to(3 * centres[:, 0, None, None], (2, NUM_JOINTS, 1, 3)).astype(np.float32)
    alone = cams._replace(view_mask=np.array([[True, False, False]] * 2))
    assert np.asarray(read(said, alone, behind) == 0).all()
    assert np.asarray(read(said, alone, behind + np.float32(5.0)) == 0).all()
    np.testing.assert_allclose(read(said, cams, joints[:, :, None]), 1, atol=1e-6)


def test_a_fresh_decoder_moves_nothing() -> None:
    joints, cams = scene(4)
    decoder = JointDecoder(MICRO, 3, 0.1, rngs=nnx.Rngs(params=0))
    layers = moved(decoder, joints, evidence_of(joints, cams), maps_of(cams), cams)
    assert len(layers) == MICRO.num_layers
    for at in layers:
        np.testing.assert_allclose(at, joints, atol=1e-7)


def test_it_turns_with_the_world() -> None:
    """Written in the hand's frame, the step is the same for every orientation."""
    joints, cams = scene(5)
    decoder, said, maps = random_decoder(), evidence_of(joints, cams), maps_of(cams)
    R = rotation_from_axis_angle(np.array([0.5, -1.0, 0.7]))
    turned_world = rigid(R, np.array([0.1, -0.2, 0.3]))
    turned_joints = (joints @ R.T + turned_world[:3, 3]).astype(np.float32)
    turned_cams = cams._replace(
        T_cam_from_world=(cams.T_cam_from_world @ np.linalg.inv(turned_world)).astype(np.float32)
    )
    here = np.asarray(moved(decoder, joints, said, maps, cams)[-1])
    there = np.asarray(moved(decoder, turned_joints, said, maps, turned_cams)[-1])
    assert np.abs(here - joints).max() > 2e-3
    np.testing.assert_allclose(there, here @ R.T + turned_world[:3, 3], atol=1e-5)


def test_in_training_a_layer_learns_from_its_own_step() -> None:
    joints, cams = scene(6)
    decoder = random_decoder()
    graph, weights = nnx.split(decoder)

    said, maps = evidence_of(joints, cams), maps_of(cams)

    @functools.partial(jax.jit, static_argnums=1)
    @jax.grad
    def last(weights, training):
        layers = nnx.merge(graph, weights)(joints, said, maps, cams, HW, training=training)
        return jnp.sum(layers[-1] ** 2)

    def first_layer(training):
        return last(weights, training)["layers"][0]["offset"]["kernel"][...]

    assert not np.any(first_layer(True))
    assert np.any(first_layer(False))


def test_it_learns_to_mend_joints_of_hands_it_has_not_seen() -> None:
    """Starts a centimetre off, heat maps that say where the joints are: what triangulation alone would not
    give back, the layers find."""

    def case(seed):
        joints, cams = scene(seed, batch=16)
        noise = 0.006 * np.random.default_rng(seed + 100).normal(size=joints.shape).astype(np.float32)
        return joints, joints + noise, evidence_of(joints, cams), cams

    decoder = JointDecoder(replace(MICRO, num_layers=1, width=32), 3, 0.1, rngs=nnx.Rngs(params=0))
    graph, weights = nnx.split(decoder)

    def error(weights, joints, start, said, cams):
        empty = jnp.zeros((*cams.view_mask.shape, CELLS, CELLS, 3))
        last = nnx.merge(graph, weights)(start, said, empty, cams, HW, training=True)[-1]
        return jnp.mean(jnp.linalg.norm(last - joints, axis=-1))

    optimizer = optax.adam(5e-3)

    @jax.jit
    def step(weights, state, *arguments):
        updates, state = optimizer.update(jax.grad(error)(weights, *arguments), state)
        return optax.apply_updates(weights, updates), state

    state = optimizer.init(weights)
    cases = [case(seed) for seed in range(8)]
    for i in range(150):
        weights, state = step(weights, state, *cases[i % len(cases)])
    joints, start, said, cams = case(50)
    before = np.linalg.norm(start - joints, axis=-1).mean()
    assert error(weights, joints, start, said, cams) < 0.6 * before


@pytest.mark.slow
def test_unsolved_samples_rest_and_disturb_no_gradient(joints_config, make_params, make_scene) -> None:
    """One view and a root: nothing is triangulated, so the hand rests; the other sample learns as ever."""
    images, cams = make_scene(2, 3)
    cams = cams._replace(view_mask=np.array([[True, False, False], [True, True, True]]))
    params = make_params(joints_config)
    root = np.zeros((2, 3), np.float32)

    @jax.jit
    def of_first_layer(trainable, images, cams, root):
        run = functools.partial(forward, config=joints_config, train=True, frozen=Frozen.VIEWS)

        def loss(trainable):
            found = run({**params, "trainable": trainable}, images, cams, root_world=root)[0]
            return jnp.sum(found.layers_world[:, 0] ** 2), found.layers_world[:, 0]

        gradients, first = jax.grad(loss, has_aux=True)(trainable)
        return gradients["joint_decoder"], first

    both, layer = of_first_layer(params["trainable"], images, cams, root)
    alone, _ = of_first_layer(params["trainable"], *jax.tree.map(lambda x: x[1:], (images, cams, root)))
    resting = params["constants"]["template_queries"]
    np.testing.assert_allclose(layer[0] @ cams.T_cam_from_world[0, 0, :3, :3].T, resting, atol=1e-5)
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(alone)) > 1e-4
    apart = jax.tree.map(lambda a, b: np.abs(a - b).max() / max(np.abs(b).max(), 1e-4), both, alone)
    assert max(jax.tree.leaves(apart)) < 1e-2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_heads": 3}, "multiple of `num_heads`"),
        ({"shells_m": ()}, "shells_m"),
        ({"shells_m": (0.0,)}, "positive"),
    ],
)
def test_wrong_configs_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(MICRO, **change)


def test_it_needs_joints_that_pose_the_template(joints_config) -> None:
    decoder = replace(joints_config.decoder, first_queries=FirstQueries.TEMPLATE)
    with pytest.raises(ValueError, match="first_queries"):
        replace(joints_config, decoder=decoder)
