"""How much a training sample is changed: recipes, and the numbers drawn for one sample by them.

`PAPER` follows the paper's section "Data Augmentation" (centre offset, scaling, colour, turns that leave the
hand in place), exactly, without the releases' truncations. The paper names no constants; these, and that the
first view is never turned, are those of its release, v2. `RELEASE_V1` and `RELEASE_V2` are the released
readers. Their distributions are met, not their random streams.
"""

import dataclasses
import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from poem_jax.typing import Array, Bool, Float, Int


class CropFormulas(enum.Enum):
    """See `data/crops.py`."""

    EXACT = "exact"
    RELEASE = "release"


@dataclass(frozen=True)
class Recipe:
    """Spreads and probabilities. Angles in radians; all draws are one a view."""

    formulas: CropFormulas = CropFormulas.EXACT
    box_ratio: float = 2.0
    """Side of the square crop over the longer side of the box around the hand."""
    center_jitter: float = 0.0
    """Spread of the centre, over the square's side."""
    scale_jitter: float = 0.0
    """Spread of the side, over the side."""
    turn: float = 0.0
    """Spread of the angle by which an image is turned."""
    turn_probability: float = 1.0
    first_view_turns: bool = False
    clip_at: float | None = None
    """Normal numbers of centre, scale and turn are held to so many spreads; None = they are not."""
    gain: float = 0.0
    """Each channel is multiplied by 1 - gain .. 1 + gain."""
    occlusion_probability: float = 0.0
    """Of a patch of noise on the hand."""
    rotation_noise: float = 0.0
    """Spread of calibration errors about each axis of all cameras but the first. Not of the paper."""
    translation_noise: float = 0.0
    """Spread, likewise, along each axis; metres."""
    shrinks_while_decoding: bool = False
    """A decoder that can (`turbo`) may decode images smaller that the crop would shrink anyway."""

    def __post_init__(self) -> None:
        if self.formulas is CropFormulas.RELEASE and self.shrinks_while_decoding:
            raise ValueError(
                "`shrinks_while_decoding` changes pixels, and the releases' recipes are to give theirs; "
                "use it with `CropFormulas.EXACT`"
            )

    def without_jitter(self) -> "Recipe":
        """Return the same crop with nothing drawn, for evaluation."""
        kept = (self.formulas, self.box_ratio)
        return Recipe(*kept, shrinks_while_decoding=self.shrinks_while_decoding)


RELEASE_V2 = Recipe(
    formulas=CropFormulas.RELEASE,
    center_jitter=0.05,
    scale_jitter=0.06,
    turn=math.radians(5),
    turn_probability=0.5,
    gain=0.3,
)
RELEASE_V1 = dataclasses.replace(
    RELEASE_V2, center_jitter=0.0, first_view_turns=True, clip_at=3.0, occlusion_probability=0.2
)
PAPER = dataclasses.replace(RELEASE_V2, formulas=CropFormulas.EXACT)
NONE = Recipe()
"""Evaluation: nothing is drawn. Released weights are evaluated with `RELEASE_V2.without_jitter()`."""


class Draws(NamedTuple):
    """The numbers that decide one sample, in the order of its views."""

    shift: Float[Array, "view 2"]
    """Of the centre, over the square's side."""
    scale: Float[Array, " view"]
    """Of the side."""
    angle: Float[Array, " view"]
    """Radians, clockwise; 0 = not turned."""
    gains: Float[Array, "view 3"]
    """Of red, green, blue."""
    occluded: Bool[Array, " view"]
    patch: Float[Array, "view 4"]
    """Share of the square's area, height over width, and where it lies from left to right and top to bottom,
    0..1."""
    noise_seed: Int[Array, " view"]
    """Of the patch's pixels."""
    calibration_error: Float[Array, "view 6"]
    """Axis-angle and shift in the camera's frame, radians and metres; zero for the first view."""


PATCH_AREA, PATCH_SHAPE = (0.0, 0.2), (0.5, 2.0)
"""Ranges of the first two numbers of `Draws.patch` (both releases)."""


def draw(recipe: Recipe, num_views: int, rng: np.random.Generator) -> Draws:
    """Draw the numbers for a sample of `num_views` views.

    As many are drawn whatever the recipe's constants are.
    """
    normal = rng.standard_normal((num_views, 4))
    if recipe.clip_at is not None:
        normal = np.clip(normal, -recipe.clip_at, recipe.clip_at)
    turned = rng.uniform(size=num_views) <= recipe.turn_probability
    if not recipe.first_view_turns:
        turned[0] = False
    gains = rng.uniform(1 - recipe.gain, 1 + recipe.gain, (num_views, 3))
    occluded = rng.uniform(size=num_views) < recipe.occlusion_probability
    low, high = np.transpose([PATCH_AREA, PATCH_SHAPE, (0, 1), (0, 1)])
    patch = rng.uniform(low, high, (num_views, 4))
    seeds = rng.integers(2**63, size=num_views)
    spreads = [recipe.rotation_noise] * 3 + [recipe.translation_noise] * 3
    calibration_error = spreads * rng.standard_normal((num_views, 6))
    calibration_error[0] = 0
    return Draws(
        shift=recipe.center_jitter * normal[:, :2],
        scale=1 + recipe.scale_jitter * normal[:, 2],
        angle=recipe.turn * normal[:, 3] * turned,
        gains=gains,
        occluded=occluded,
        patch=patch,
        noise_seed=seeds,
        calibration_error=calibration_error,
    )
