"""Every preset, made small, learns one batch by the loss that belongs to it."""

from collections import defaultdict
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from poem_jax.losses import SYNTHETIC
from poem_jax.models.apply import init
from poem_jax.models.config import Config, ModelConfig
from poem_jax.models.presets import PRESETS
from poem_jax.models.systems import MODULES
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.training.config import BatchShape, DataConfig, Schedule, TrainConfig
from poem_jax.training.recipes import RECIPES, experiment
from poem_jax.training.state import create_state
from poem_jax.training.step import train_step
from tests.small_presets import NUM_VIEWS, small, with_joint_decoder

BATCH, STEPS = 1, 30
IN_DEFAULT_SUITE = {"v1", "pe-meshtr", "mvp"}
"""One of each system but POEM v2, of which `test_step.py` has tests enough; compiling the step of
another takes 10 s or more again."""


def recipe_of(name: str) -> str:
    """Return the recipe of a preset, as docs/models.md has it; "" for those of a whole experiment."""
    if name in ("tiny", "tiny-joint-decoder", "v2-nano"):
        return ""
    if name in RECIPES:
        return name
    if name.startswith("v1-release"):
        return "v1-release"
    if name.startswith("v1-"):
        return "v1"
    return {"v2-medium-mano-release": "release-mano"}.get(name, "release" if "release" in name else "paper")


def experiments() -> dict[str, tuple[str, ModelConfig]]:
    """Name what differs when it is small: recipe and model, by the presets that they stand for."""
    models = {name: small(config) for name, config in PRESETS.items()}
    models["tiny-joint-decoder"] = with_joint_decoder(models["tiny"])
    alike = defaultdict(list)
    for name, model in models.items():
        alike[recipe_of(name), model].append(name)
    return {" ".join(names): chosen for chosen, names in alike.items()}


def experiment_of(recipe: str, model: ModelConfig) -> TrainConfig:
    fields = {
        "name": "small",
        "model": model,
        "data": DataConfig(
            synthetic=SyntheticConfig(image_hw=model.image_hw, num_views=NUM_VIEWS),
            batches=(BatchShape(NUM_VIEWS, BATCH),),
        ),
    }
    config = experiment(recipe, **fields) if recipe else TrainConfig(**fields, loss=SYNTHETIC)
    rate = {"learning_rate": 3e-3, "schedule": Schedule.CONSTANT}
    return replace(config, optimizer=replace(config.optimizer, **rate))


CASES = [
    pytest.param(*chosen, id=names, marks=[] if IN_DEFAULT_SUITE & {*names.split()} else pytest.mark.slow)
    for names, chosen in experiments().items()
]


def test_every_system_is_in_the_default_suite():
    assert {type(PRESETS[name]) for name in IN_DEFAULT_SUITE} | {Config} == set(MODULES)


@pytest.mark.parametrize(("recipe", "model"), CASES)
def test_the_loss_falls(recipe, model, batch_at):
    config, batch = experiment_of(recipe, model), batch_at(0, BATCH, NUM_VIEWS, 0.05)
    step = jax.jit(partial(train_step, config=config), donate_argnums=0)
    state, losses = create_state(init(model, key=jax.random.key(0)), config), []
    for _ in range(STEPS):
        state, found = step(state, batch, jax.random.key(0))
        losses.append(float(found["loss"]))
    losses = np.array(losses)
    assert np.isfinite(losses).all()
    # Zero would be that of a sample which counts as unsolved.
    assert 0 < losses[-5:].mean() < 0.85 * losses[:5].mean()
