"""What is scored on a data set: anything that turns a batch of calibrated views into hands."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.data.augmentation_recipes import NONE, RELEASE_V2, Recipe
from poem_jax.data.batching import pad_views
from poem_jax.data.frames import MultiViewFrame
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import QueryOrder
from poem_jax.models.apply import apply
from poem_jax.models.config import ModelConfig
from poem_jax.typing import Array, Bool, Float, Int, Params


class Answer(NamedTuple):
    """Hands found in a batch, in the world of its cameras, metres."""

    joints_world: Float[Array, "batch 21 3"]
    vertices_world: Float[Array, "batch 778 3"]
    valid: Bool[Array, " batch"]
    """False where the system itself says that it found none; finite numbers that mean nothing there."""


class Seen(NamedTuple):
    """What a sample of a batch was made of."""

    frame: MultiViewFrame
    views: Int[Array, " chosen"]
    """Of the frame, in the sample's order."""


@runtime_checkable
class System(Protocol):
    """A model with its weights, or a way to fit a hand."""

    hand: HandModel
    """Whose vertices it finds."""
    image_hw: tuple[int, int]
    """Of the crops that it wants."""
    recipe: Recipe
    """How they are cut."""
    least_views: int
    """Of a sample whose root it is not given."""
    most_views: int | None
    """None = any number."""
    takes_root: bool
    """Whether it reads `MultiViewBatch.root_world`, of which a row of NaN is unknown."""
    one_at_a_time: bool
    """Whether a sample's hand would depend on the others of its batch."""

    def __call__(self, batch: MultiViewBatch, seen: Sequence[Seen]) -> Answer:
        """Find one hand per sample.

        Args:
            batch: padded views and samples.
            seen: where its real samples come from, first ones first.
        """
        ...


_apply = jax.jit(apply, static_argnames="config")


class Network:
    """A model and its weights; every shape of batch compiles once for all models of a config."""

    def __init__(self, config: ModelConfig, params: Params) -> None:
        """Take the model.

        Raises:
            ValueError: it was trained on upright hands, to which crops of data sets are not turned.
        """
        if config.crop.upright:
            raise ValueError(
                "`crop.upright` is for models of upright hands, and crops of data sets are not turned upright"
            )
        self.hand = HandModel(**jax.device_get(params["constants"]["hand"]))
        self.image_hw, self.recipe = config.image_hw, crops_of(config)
        self.least_views = 2 if config.triangulates else 1
        self._padded_to, self.most_views = config.view_range
        self.takes_root = config.takes_root
        self.one_at_a_time = config.couples_samples
        self._config, self._params = config, params

    def __call__(self, batch: MultiViewBatch, seen: Sequence[Seen]) -> Answer:
        """Find one hand per sample; see `System`."""
        padded = pad_views(batch, max(batch.views.shape[1], self._padded_to))
        root = {"root_world": padded.root_world} if self.takes_root else {}
        found = _apply(self._params, padded.views, padded.cameras, config=self._config, **root)
        return Answer(*map(np.asarray, (found.joints_world, found.vertices_world, found.valid)))


def crops_of(config: ModelConfig) -> Recipe:
    """Return how crops are cut for a model at test time: nothing is drawn, its own ratio, and for released
    models, which alone have the joints before the vertices, the release's formulas."""
    is_release = config.query_order is QueryOrder.JOINTS_FIRST
    recipe = (RELEASE_V2 if is_release else NONE).without_jitter()
    return Recipe(recipe.formulas, config.crop.ratio)
