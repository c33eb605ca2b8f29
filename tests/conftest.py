"""Settings that hold for the whole suite."""

import os
from pathlib import Path

# Eight host devices let the tests of data-parallel training run on a CPU; JAX reads this when it starts.
os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=8")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Devices that wait for each other hold threads of the shared pool; on few cores they would starve.
os.environ.setdefault("PJRT_NPROC", "32")

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of reference material beside the checkout; tests that need it skip where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("reference material (../shared) is not on this machine")
    return SHARED


@pytest.fixture(scope="session")
def micro_model():
    """Config and parameters of a model that compiles in seconds and has learned nothing."""
    import jax

    from poem_jax.models.config import BasisConfig, Config, DecoderConfig, ResNetConfig, Stem
    from poem_jax.models.poem import init

    config = Config(
        image_hw=(64, 64),
        width=16,
        backbone=ResNetConfig(
            (1, 1, 1, 1), (8, 8, 8, 8), bottleneck=False, stem=Stem.SPACE_TO_DEPTH, stem_channels=8
        ),
        basis=BasisConfig(num_points=64),
        decoder=DecoderConfig(num_layers=1, num_neighbours=4, ffn_expansion=1),
    )
    return config, jax.jit(lambda key: init(config, key=key))(jax.random.key(0))
