"""A model small enough to train in a test, and batches for it."""

from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np
import pytest

from poem_jax.batch import MultiViewBatch
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.hand import default_hand, hand_mesh
from poem_jax.losses import SYNTHETIC
from poem_jax.models.apply import init
from poem_jax.models.config import HeatActivation, RootConfig
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.training.config import BatchShape, DataConfig, OptimizerConfig, RunConfig, TrainConfig
from poem_jax.training.state import TrainState, create_state
from tests import micro

VIEWS, BATCH, HW = 3, 8, (32, 32)

MICRO = replace(
    micro.MICRO,
    root=RootConfig(stride=4, activation=HeatActivation.SOFTMAX),
    decoder=replace(micro.MICRO.decoder, num_heads=2, ffn_expansion=2),
)


@pytest.fixture(scope="session")
def micro_params() -> dict:
    return init(MICRO, key=jax.random.key(0))


@pytest.fixture(scope="session")
def drawn_params(micro_params) -> dict:
    """Weights without the zeros of fresh ones, which keep gradients from all that lies before them."""
    rng = np.random.default_rng(5)

    def disturb(leaf):
        return np.asarray(leaf + 0.05 * rng.normal(size=leaf.shape), np.float32)

    return {**micro_params, "trainable": jax.tree.map(disturb, micro_params["trainable"])}


@pytest.fixture
def micro_config(tmp_path) -> TrainConfig:
    return TrainConfig(
        name="micro",
        model=MICRO,
        loss=SYNTHETIC,
        data=DataConfig(
            synthetic=SyntheticConfig(image_hw=HW, num_views=VIEWS, supersample=1, num_backgrounds=2),
            batches=(BatchShape(num_views=VIEWS, batch_size=BATCH),),
        ),
        optimizer=OptimizerConfig(learning_rate=1e-3, ema_decay=0.9, decay_steps=4),
        train=RunConfig(steps=4, out=str(tmp_path / "run"), log_every=2, checkpoint_every=2, progress=False),
    )


@pytest.fixture
def micro_state(micro_params, micro_config) -> TrainState:
    return create_state(micro_params, micro_config)


@pytest.fixture(scope="session")
def micro_batch() -> MultiViewBatch:
    return _make_batch(0)


@pytest.fixture(scope="session")
def batch_at() -> Callable[[int], MultiViewBatch]:
    return _make_batch


def _make_batch(
    step: int, batch: int = BATCH, views: int = VIEWS, off_centre_m: float = 0.0
) -> MultiViewBatch:
    """Posed hands with exact labels; each image shows where the joints are, and noise.

    All cameras look at the world's origin; the root joint lies up to `off_centre_m` away along each axis.
    """
    rng = np.random.default_rng((7, step))
    pose = rng.normal(0, 0.4, (batch, 16, 3)).astype(np.float32)
    shape = rng.normal(0, 1, (batch, 10)).astype(np.float32)
    mesh = hand_mesh(default_hand(), pose, shape, center_joint=9)
    place = rng.uniform(-off_centre_m, off_centre_m, (batch, 1, 3)).astype(np.float32)
    mesh = mesh._replace(vertices=mesh.vertices + place, joints=mesh.joints + place)
    K = np.array([[40, 0, 16], [0, 40, 16], [0, 0, 1]], np.float32)
    K = np.tile(K, (batch, views, 1, 1))
    T = np.tile(np.eye(4, dtype=np.float32), (batch, views, 1, 1))
    for b, v in np.ndindex(batch, views):
        angle = 2.0 * v + 0.3 * rng.normal()
        c, s = np.cos(angle), np.sin(angle)
        T[b, v, :3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        T[b, v, 2, 3] = 0.4
    keypoints = project(K, T, mesh.joints[:, None])[0]
    images = rng.uniform(0, 0.3, (batch, views, *HW, 3))
    for b, v, j in np.ndindex(batch, views, 21):
        u, w = np.clip(keypoints[b, v, j], 0, 31).astype(int)
        images[b, v, w, u] += (j / 21, 0.5, 1 - j / 21)
    return MultiViewBatch(
        views=(255 * np.clip(images, 0, 1)).astype(np.uint8),
        cameras=Cameras(K, T),
        joints_world=mesh.joints,
        vertices_world=mesh.vertices,
        keypoints_px=keypoints,
        pose=pose,
        shape=shape,
        sample_mask=np.ones(batch, bool),
    )
