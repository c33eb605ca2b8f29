"""Which rows are measured, in the order of their value."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from poem_jax.experiments.tiny_accelerator import config as tiny_accelerator
from poem_jax.experiments.tiny_synthetic import config as tiny_synthetic
from poem_jax.experiments.v2_base_synthetic import config as v2_base_synthetic
from poem_jax.models.config import (
    BasisConfig,
    Config,
    DecoderConfig,
    HeatActivation,
    ResNetConfig,
    RootConfig,
    Stem,
)
from poem_jax.models.presets import preset
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.training.config import BatchShape, DataConfig, Precision, TrainConfig
from tools.accelerator.rows import Fitting, Inference, Machine, Row, Training

HALF, FULL = Precision.BFLOAT16, Precision.FLOAT32


@dataclass(frozen=True)
class Plan:
    """What is measured, and what is trained on for the rest of the time."""

    machine: Machine
    rows: tuple[Row, ...]
    going_on: TrainConfig
    patience: float = 2.5
    """How many times its guess a row may take; the next ones are to have a chance."""


def whole_plan() -> Plan:
    """Return what a GPU is asked: the promises of README.md first, then what else is worth knowing."""
    model = preset("v2-base")
    assert isinstance(model, Config)

    def inference(precision: Precision, views: int, *batches: int, packed: bool = False) -> list[Row]:
        return [Inference("v2-base", model, precision, views, batch, packed) for batch in batches]

    def training(name: str, config: TrainConfig, precision: Precision, *batches: int) -> list[Row]:
        return [Training(name, config, precision, batch) for batch in batches]

    rows = [
        *inference(HALF, 8, 32, 1),
        *training("v2-base", v2_base_synthetic, HALF, 32),
        *inference(FULL, 8, 32, 1),
        *training("tiny", tiny_synthetic, FULL, 256),
        Fitting(frames=500),
        *training("v2-base", v2_base_synthetic, HALF, 64),
        *training("tiny", tiny_synthetic, HALF, 256),
        *training("v2-base", v2_base_synthetic, FULL, 32),
        *inference(HALF, 8, 8),
        *inference(FULL, 8, 8),
        *inference(HALF, 4, 32, 1),
        *inference(HALF, 1, 32, 1),
        *inference(HALF, 8, 32, 1, packed=True),
        *training("tiny", tiny_synthetic, FULL, 512, 64),
        *training("v2-base", v2_base_synthetic, HALF, 16),
        *inference(FULL, 4, 32, 1),
        *inference(FULL, 1, 32, 1),
        *[row for precision in (HALF, FULL) for views in (4, 1) for row in inference(precision, views, 8)],
        Fitting(frames=5000),
    ]
    return Plan(Machine(8192), tuple(rows), tiny_accelerator)


def micro_plan() -> Plan:
    """Return the same kinds of rows at a size that a CPU takes in seconds, to see that they run."""
    model = Config(
        image_hw=(32, 32),
        width=16,
        backbone=ResNetConfig(
            blocks=(1, 1), channels=(8, 16), bottleneck=False, stem=Stem.SPACE_TO_DEPTH, stem_channels=8
        ),
        root=RootConfig(stride=4, activation=HeatActivation.SOFTMAX),
        basis=BasisConfig(num_points=64),
        decoder=DecoderConfig(num_layers=1, num_neighbours=4, num_heads=2, ffn_expansion=1),
    )
    experiment = replace(
        tiny_accelerator,
        name="micro",
        model=model,
        data=DataConfig(
            synthetic=SyntheticConfig(image_hw=(32, 32), num_views=2, supersample=1, num_backgrounds=2),
            batches=(BatchShape(num_views=2, batch_size=2, min_views=1),),
        ),
        train=replace(
            tiny_accelerator.train,
            out="runs/micro_accelerator",
            init_from=None,
            steps=10_000,
            checkpoint_every=100,
            log_every=2,
            validate_every=0,
            host_devices=1,
        ),
    )
    rows = (
        Inference("micro", model, HALF, 2, 2, about_s=5),
        Training("micro", experiment, HALF, 2, about_s=5),
        Inference("micro", model, HALF, 2, 1, packed=True, about_s=5),
        Fitting(frames=4, views=2, about_s=5),
    )
    return Plan(Machine(256), rows, experiment, patience=200)


PLANS: dict[str, Callable[[], Plan]] = {"whole": whole_plan, "micro": micro_plan}
"""By the name of their size."""
