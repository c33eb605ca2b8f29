"""Configuration of MvP, the baseline of the paper's main experiments (`mvp.py`)."""

from dataclasses import dataclass, field

from poem_jax.hand.topology import QueryOrder
from poem_jax.models.config import (
    MAX_LAYERS,
    CropConfig,
    Design,
    ModelConfig,
    ResNetConfig,
    require,
    require_counts,
    require_images,
)
from poem_jax.models.frustum_config import DEXYCB_CUBOID, Cuboid

NUM_LEVELS = 3
"""Feature maps that are read: the trunk's coarsest ones."""


@dataclass(frozen=True)
class MvpDecoderConfig:
    """The row of decoder layers."""

    num_layers: int = 6
    num_heads: int = 8
    num_points: int = 4
    """Sampled points per query, head, feature map and view."""
    ffn_expansion: int = 4
    """Width of the hidden layer of the feed-forward network over the model's width."""
    dropout: float = 0.1

    def __post_init__(self) -> None:
        require_counts(self, "num_layers", most=MAX_LAYERS)
        require_counts(self, "num_heads", "num_points", "ffn_expansion")
        require(0 <= self.dropout < 1, f"`dropout` must be in [0, 1); got {self.dropout}")


@dataclass(frozen=True)
class MvpConfig(ModelConfig):
    """A whole MvP."""

    design: Design = Design.PAPER
    """How queries are made, views read and the hand regressed; `mvp.py` lists what differs."""
    num_views: int = 8
    """Views that the model takes, neither more nor fewer: two kinds of layers are as wide as that. A sample
    with fewer is padded to it."""
    image_hw: tuple[int, int] = (256, 256)
    image_mean: float = 0.5
    image_std: float = 1.0
    crop: CropConfig = CropConfig()
    width: int = 256
    backbone: ResNetConfig = field(default_factory=ResNetConfig.resnet34)
    cuboid: Cuboid = DEXYCB_CUBOID
    """Where joints can be; coordinates are regressed as shares of it."""
    decoder: MvpDecoderConfig = MvpDecoderConfig()

    def __post_init__(self) -> None:
        require_counts(self, "num_views", "image_hw", "width")
        strides = self.backbone.strides
        require_images(self, strides)
        require(
            len(strides) >= NUM_LEVELS,
            f"`backbone` must have at least {NUM_LEVELS} stages, whose maps are read; got {len(strides)}",
        )
        require(
            self.design is Design.PAPER or min(self.image_hw) > strides[-1],
            "`image_hw` must give coarsest maps of more than one cell a side with `design` = release, which "
            f"divides by that less one; got {self.image_hw} and the stride {strides[-1]}",
        )
        require(
            self.width % self.decoder.num_heads == 0,
            f"`width` must be a multiple of `num_heads` = {self.decoder.num_heads}; got {self.width}",
        )

    @property
    def query_order(self) -> QueryOrder:
        """Layout of the 799 points of a layer."""
        return QueryOrder.JOINTS_FIRST if self.design is Design.RELEASE else QueryOrder.VERTICES_FIRST

    @property
    def view_range(self) -> tuple[int, int]:
        """As many as its layers are made for, masked ones counted."""
        return self.num_views, self.num_views

    @property
    def couples_samples(self) -> bool:
        """The release divides all projections by the largest number in the batch."""
        return self.design is Design.RELEASE
