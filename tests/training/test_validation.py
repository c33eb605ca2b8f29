"""Validation: errors by number of views and by part, padded samples left out, and a picture."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.batch import Prediction
from poem_jax.data.view_sampling import UniformViews
from poem_jax.mixture.config import CapturesSource, MixtureConfig, Part
from poem_jax.training import held_out
from poem_jax.training import validation as module
from poem_jax.training.config import BatchShape
from poem_jax.training.held_out import held_out_batches
from poem_jax.training.parallel import data_mesh
from poem_jax.training.source import open_training_data
from poem_jax.training.validation import UNSOLVED_MM, Validation
from tests.mixture.fake_frames import FakeFrames

TRUTH_M = 0.25
"""Where the model of these tests puts every vertex, joint and root, along each axis."""


def answer(params, views, cameras, *, config, root_world=None):
    """Stand for `apply`: says the same of every sample; one that starts with a masked view is not solved."""
    del params, config
    batch = views.shape[0]
    place = TRUTH_M if root_world is None else 0.0
    root = jnp.full((batch, 3), place)
    vertices = jnp.full((batch, 778, 3), place) + jnp.linspace(0, 0.02, 778)[:, None]
    return Prediction(
        vertices, jnp.full((batch, 21, 3), place), root, None, jnp.zeros((batch, 1, 799, 3)), cameras[2][:, 0]
    )


@pytest.fixture
def config(micro_config, monkeypatch):
    """Five held-out frames of three views, in batches of up to 4."""
    monkeypatch.setattr(module, "apply", answer)
    monkeypatch.setattr(CapturesSource, "open", lambda source: FakeFrames("my rig", length=10))
    part = Part(CapturesSource(("x",)), 1.0, UniformViews(), held_out=0.5)
    train = replace(micro_config.train, validation_views=(2, 3), validation_samples=8)
    data = replace(
        micro_config.data, mixture=MixtureConfig((part,), processes=0), batches=(BatchShape(3, 4),)
    )
    return replace(micro_config, data=data, train=train)


def one_device():
    return data_mesh(jax.devices()[:1])


def test_errors_are_told_by_views_and_by_part_and_compared_by_part(config, micro_state):
    validation = Validation(config, one_device())
    errors = validation(micro_state)
    names = ("mpvpe_mm", "median_mpvpe_mm", "root_mm", "true_root_mpvpe_mm", "unsolved_share")
    assert errors.keys() == {f"{name}_{group}" for name in names for group in ("2views", "3views", "my_rig")}
    assert validation.score(errors) == errors["mpvpe_mm_my_rig"]
    frames = FakeFrames("my rig", length=10)
    true = [frames[i] for i in range(5, 10)]
    vertices = TRUTH_M + np.linspace(0, 0.02, 778)[:, None]
    expected = [1000 * np.linalg.norm(vertices - frame.vertices_cam[0], axis=-1).mean() for frame in true]
    assert errors["mpvpe_mm_my_rig"] == pytest.approx(np.mean(expected), rel=1e-4)
    assert errors["median_mpvpe_mm_my_rig"] == pytest.approx(np.median(expected), rel=1e-4)


def test_without_held_out_frames_checkpoints_are_compared_by_views(config, micro_state):
    alone = replace(config, data=replace(config.data, mixture=None))
    validation = Validation(alone, one_device())
    errors = {"mpvpe_mm_2views": 4.0, "mpvpe_mm_3views": 2.0}
    solved = {"unsolved_share_2views": 0.0, "unsolved_share_3views": 0.0}
    assert validation.score(errors | solved) == 3.0


def test_samples_that_are_not_solved_are_no_part_of_the_means_but_of_the_score(config, micro_state):
    validation = Validation(config, one_device())
    whole = validation(micro_state)
    batches = validation._by_part["my_rig"]
    lost = batches[-1].cameras.view_mask
    lost[:, 0] = False
    errors = validation(micro_state)
    assert (whole["unsolved_share_my_rig"], errors["unsolved_share_my_rig"]) == pytest.approx((0, 0.2))
    assert errors["mpvpe_mm_2views"] == whole["mpvpe_mm_2views"]
    assert validation.score(errors) == pytest.approx(0.8 * errors["mpvpe_mm_my_rig"] + 0.2 * UNSOLVED_MM)
    for batch in batches:
        batch.cameras.view_mask[:, 0] = False
    errors = validation(micro_state)
    assert {name: value for name, value in errors.items() if name.endswith("my_rig")} == {
        "unsolved_share_my_rig": 1.0
    }
    assert validation.score(errors) == UNSOLVED_MM


def test_two_parts_whose_names_read_alike_are_both_watched(config):
    part = config.data.mixture.parts[0]
    mixture = open_training_data(
        replace(config, data=replace(config.data, mixture=MixtureConfig((part, part, part), processes=0)))
    )
    for samples, name in zip(mixture.parts, ("my rig", "my-rig", "my_rig"), strict=True):
        samples.source.name = name
    assert list(held_out_batches(config, mixture)) == ["my_rig", "my_rig_2", "my_rig_3"]


def test_hosts_must_be_able_to_use_the_same_frames(config, monkeypatch):
    seen = []
    monkeypatch.setattr(held_out, "check_same_everywhere", lambda *args: seen.append(args))
    held_out_batches(config)
    assert seen == [("held-out frames of my rig that can be used", "[0, 1, 2, 3, 4]")]


def test_samples_that_fill_a_batch_are_marked(config):
    (batches,) = held_out_batches(config, multiple_of=2).values()
    assert [batch.views.shape[:2] for batch in batches] == [(4, 3), (4, 3)]
    assert [batch.sample_mask.sum() for batch in batches] == [4, 1]
    few = replace(config, train=replace(config.train, validation_samples=3))
    (batches,) = held_out_batches(few, multiple_of=2).values()
    assert [batch.sample_mask.tolist() for batch in batches] == [[True, True, True, False]]


def test_frames_of_one_view_are_refused_by_a_model_that_triangulates_before_it_steps(config, monkeypatch):
    monkeypatch.setattr(CapturesSource, "open", lambda source: FakeFrames("lone", length=10, views=1))
    with pytest.raises(
        ValueError, match=r"none of 5 held-out frames of lone can be used; a Config needs 2 views"
    ):
        Validation(config, one_device())


def test_the_panel_shows_all_views_of_held_out_samples(config, micro_state):
    panel = Validation(config, one_device()).panel(micro_state)
    assert panel.shape == (4 * 32, 3 * 32, 3)
    tiles = panel.reshape(4, 32, 3, 32, 3).swapaxes(1, 2)
    assert all(np.ptp(tile) > 0 for row in tiles for tile in row)
