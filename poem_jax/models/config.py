"""Configuration of the models: what every system's says, `ModelConfig`, and that of POEM v2, `Config`.

Frozen dataclasses nested by owner; the other systems have a file each for theirs. Where the paper and the
released models differ in a whole part, the part names its `Design`; single choices are fields of the part
that has them. Cross-field rules are checked on construction.
"""

import enum
import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES, QueryOrder


def require(condition: bool, message: str) -> None:
    """Raise `ValueError(message)` unless the condition holds."""
    if not condition:
        raise ValueError(message)


MAX_COUNT = 2**16
"""Of points, channels or pixels along a side; the largest model has 4096. A config.json may come from
anywhere, and what it asks for is built before its weights are read."""
MAX_LAYERS = 256
"""Of layers, blocks or modules in a row; the largest model has 9."""


def require_images(config: "ModelConfig", strides: tuple[int, ...]) -> None:
    """Insist on images that a trunk of these strides can take, and on a mean and a spread of their pixels.

    Raises:
        ValueError: names the field.
    """
    require(
        isinstance(config.image_hw, tuple) and len(config.image_hw) == 2,
        f"`image_hw` must be (height, width); got {config.image_hw}",
    )
    require(
        math.isfinite(config.image_mean) and 0 < config.image_std < math.inf,
        f"`image_mean` must be finite and `image_std` positive; got {config.image_mean}, {config.image_std}",
    )
    require(
        all(size % strides[-1] == 0 for size in config.image_hw),
        f"`image_hw` must be multiples of the trunk's coarsest stride {strides[-1]}; got {config.image_hw}",
    )


def require_counts(owner: Any, *names: str, most: int = MAX_COUNT) -> None:
    """Insist that fields are whole numbers from 1 to `most`, or tuples of at most `MAX_LAYERS` of them."""
    for name in names:
        value = getattr(owner, name)
        entries = value if isinstance(value, tuple) else (value,)
        require(len(entries) <= MAX_LAYERS, f"`{name}` must name at most {MAX_LAYERS}; got {len(entries)}")
        require(
            all(type(entry) is int and entry >= 1 for entry in entries),
            f"`{name}` must be whole and at least 1; got {value}",
        )
        require(max(entries, default=0) <= most, f"`{name}` must be at most {most}; got {value}")


class Design(enum.StrEnum):
    """Whose design a part follows, where paper and release differ in many things at once."""

    PAPER = "paper"
    RELEASE = "release"


class Frozen(enum.StrEnum):
    """What stays as it is while the rest learns, batch norms included."""

    NOTHING = "nothing"
    FIRST_STAGE = "first_stage"
    """Trunk and heat maps."""
    VIEWS = "views"
    """All that is done with every view alone: these, and the maps that the second stage reads."""


class Stem(enum.StrEnum):
    """How a ResNet reaches a quarter of the image's resolution."""

    CONVOLUTION = "convolution"
    """7 x 7 convolution of stride 2, then 3 x 3 max pooling of stride 2 (He et al. 2016)."""
    SPACE_TO_DEPTH = "space_to_depth"
    """4 x 4 pixels become 48 channels, then one 3 x 3 convolution: far cheaper on a CPU."""


class FrozenNorms(enum.StrEnum):
    """Which of a ResNet's batch norms keep what they were pre-trained to."""

    NONE = "none"
    STAGE_STARTS = "stage_starts"
    """That of the stem, and all in the first block of every stage (the v1 release)."""


@dataclass(frozen=True)
class HRNetConfig:
    """HRNet classification trunk (Wang et al. 2020): four parallel branches of strides 4, 8, 16, 32."""

    width: int = 40
    """Channels of the finest branch; each coarser one doubles them."""
    stem_channels: int = 64
    stem_blocks: int = 4
    modules: tuple[int, int, int] = (1, 4, 3)
    """Exchange modules in stages 2, 3 and 4."""
    blocks: int = 4
    """Residual blocks in every branch of a module."""

    def __post_init__(self) -> None:
        require_counts(self, "width", "stem_channels")
        require_counts(self, "stem_blocks", "modules", "blocks", most=MAX_LAYERS)
        # The first widens the map, the others are one stack of equals.
        require(self.stem_blocks >= 2, f"`stem_blocks` must be at least 2; got {self.stem_blocks}")
        require(len(self.modules) == 3, f"`modules` must name stages 2, 3 and 4; got {self.modules}")

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of the four feature maps, finest first."""
        return tuple(self.width * 2**level for level in range(4))

    @property
    def strides(self) -> tuple[int, ...]:
        """Strides of the four feature maps, finest first."""
        return (4, 8, 16, 32)


@dataclass(frozen=True)
class ResNetConfig:
    """Residual network (He et al. 2016): strides 4, 8, 16, ... stage by stage."""

    blocks: tuple[int, ...] = (3, 4, 6, 3)
    channels: tuple[int, ...] = (256, 512, 1024, 2048)
    """Channels that leave each stage."""
    bottleneck: bool = True
    stem: Stem = Stem.CONVOLUTION
    stem_channels: int = 64
    frozen_norms: FrozenNorms = FrozenNorms.NONE

    def __post_init__(self) -> None:
        require(
            len(self.blocks) == len(self.channels) >= 1,
            f"`blocks` and `channels` must name the same stages; got {self.blocks} and {self.channels}",
        )
        require_counts(self, "channels", "stem_channels")
        require_counts(self, "blocks", most=MAX_LAYERS)

    @property
    def strides(self) -> tuple[int, ...]:
        """Strides of the feature maps, finest first."""
        return tuple(4 * 2**stage for stage in range(len(self.blocks)))

    @classmethod
    def resnet18(cls) -> "ResNetConfig":
        """The 18-layer network of the paper."""
        return cls(blocks=(2, 2, 2, 2), channels=(64, 128, 256, 512), bottleneck=False)

    @classmethod
    def resnet34(cls, frozen_norms: FrozenNorms = FrozenNorms.NONE) -> "ResNetConfig":
        """The 34-layer network of the paper."""
        return cls((3, 4, 6, 3), (64, 128, 256, 512), bottleneck=False, frozen_norms=frozen_norms)

    @classmethod
    def resnet50(cls) -> "ResNetConfig":
        """The 50-layer network of the paper."""
        return cls()


class HeatActivation(enum.StrEnum):
    """What makes heat of the logits before the map is divided by its sum."""

    SIGMOID = "sigmoid"
    """As the release has it. A peak is at most 1, so the background must come down to near nothing before the
    map's expectation can leave the middle of the image."""
    SOFTMAX = "softmax"
    """The exponential function: peaks have no limit, and maps sharpen several times faster."""


class ViewWeights(enum.StrEnum):
    """How much each view says in the triangulation."""

    EQUAL = "equal"
    """All views alike (paper and release)."""
    HEAT_SPREAD = "heat_spread"
    """One over the heat map's variance: a joint that a view sees clearly has a narrow map."""


@dataclass(frozen=True)
class RootConfig:
    """First stage: heat maps, soft-argmax, triangulation."""

    num_joints: int = 1
    """1 = the root alone (paper); 21 = all joints, of which joint 9 is the root."""
    stride: int = 8
    """Pixels per heat-map cell."""
    design: Design = Design.PAPER
    """The release's branch has biases and ends at half the stride, to be max-pooled; cell i stands for pixel
    `stride` x i; 1e-6 is added to a map's sum; the rows of the triangulation stay raw pixels."""
    activation: HeatActivation = HeatActivation.SIGMOID
    view_weights: ViewWeights = ViewWeights.EQUAL

    def __post_init__(self) -> None:
        require(
            self.num_joints in (1, NUM_JOINTS),
            f"`num_joints` must be 1 (the root) or {NUM_JOINTS} (all joints); got {self.num_joints}",
        )
        require_counts(self, "stride")

    @property
    def pooling(self) -> int:
        """The branch ends so many times finer, and is max-pooled to `stride`."""
        return 2 if self.design is Design.RELEASE else 1

    @property
    def cell_offset(self) -> float:
        """Cell i stands for pixel `stride` x (i + `cell_offset`)."""
        return 0.0 if self.design is Design.RELEASE else 0.5

    @property
    def sum_epsilon(self) -> float:
        """Added to a sigmoid map's sum before its expectation is divided by it."""
        return 1e-6 if self.design is Design.RELEASE else 0.0

    @property
    def branch_stride(self) -> int:
        """Pixels per cell where the branch ends."""
        return self.stride // self.pooling


@dataclass(frozen=True)
class FeatureConfig:
    """Feature maps that the basis points sample."""

    stride: int = 8
    """Pixels per cell."""
    design: Design = Design.PAPER
    """Paper: the heat maps' branch (enlarge, concatenate the finer map, convolve); sines of the projected
    point are added to its sample; points behind a camera sample zeros. Release: convolve with stride 2 and
    add the coarser map, to the coarsest, then enlarge once; sines of the number of the view, the row and the
    column are mixed and added to the map; points behind a camera sample where they project through its
    centre."""
    heat_maps: bool = False
    """The joints' heat maps are mixed into the feature map: a basis point then knows what each view says of
    every joint at its place, and not only where the views' expectations meet."""


class BasisSampling(enum.StrEnum):
    """How the fixed basis points are drawn."""

    BALL = "ball"
    """Uniform in the ball's volume."""
    GAUSSIAN = "gaussian"
    """Normal with sigma = half the radius, rejected outside the ball."""


@dataclass(frozen=True)
class BasisConfig:
    """The fixed point cloud that carries the image features."""

    num_points: int = 4096
    radius: float = 0.1
    """Metres."""
    sampling: BasisSampling = BasisSampling.BALL
    seed: int = 0

    def __post_init__(self) -> None:
        require_counts(self, "num_points")
        require(
            0 < self.radius < math.inf, f"`radius` must be positive and finite, metres; got {self.radius}"
        )


class Similarity(enum.StrEnum):
    """Weight of a source view in the projective aggregation."""

    DOT = "dot"
    """theta(f1) . theta(fj), as the paper writes it."""
    MEAN = "mean"
    """The same divided by its number of terms, so that its size does not grow with the width."""
    EQUAL = "equal"
    """All valid views alike, the primary too: mean_j fj + phi(mean_j theta(fj))."""


@dataclass(frozen=True)
class AggregationConfig:
    """Fusion of the views' features."""

    similarity: Similarity = Similarity.DOT
    design: Design = Design.PAPER
    """The release reads its samples, (view, channel, point) in memory, as (point, view, channel), which mixes
    them; one view alone gets phi(theta(f1)) added; phi's hidden layer is as narrow as its input."""

    def __post_init__(self) -> None:
        require(
            self.design is Design.PAPER or self.similarity is not Similarity.EQUAL,
            "`aggregation.similarity` = equal needs `aggregation.design` = paper",
        )


class NeighbourSearch(enum.StrEnum):
    """When the nearest basis points of the queries are looked up."""

    EVERY_LAYER = "every_layer"
    ONCE = "once"


class FirstQueries(enum.StrEnum):
    """Where the query points stand before the first layer."""

    TEMPLATE = "template"
    """The hand template about the root (POEM v2)."""
    JOINTS = "joints"
    """The template posed by the triangulated joints (POEM v1's idea: joints initialise the vertices)."""


class DecoderOutput(enum.StrEnum):
    """What the last decoder layer regresses."""

    OFFSETS = "offsets"
    """Offsets of the query points."""
    HAND_PARAMETERS = "hand_parameters"
    """MANO pose (6D rotations) and shape."""


@dataclass(frozen=True)
class DecoderConfig:
    """Point-embedded Transformer decoder."""

    num_layers: int = 3
    num_heads: int = 4
    num_neighbours: int = 32
    ffn_expansion: int = 4
    """Hidden width of the feed-forward network over the width of the embeddings."""
    layer: Design = Design.PAPER
    """Paper: queries read each other, then the basis, then their nearest basis points; the feed-forward
    network regresses offsets. Release: queries read the basis twice, then near queries, then near basis
    points, in the first layer fixed ones; a branch regresses offsets before the feed-forward network."""
    dropout: float = 0.0
    """Share of numbers dropped in training, where the release drops them."""
    first_queries: FirstQueries = FirstQueries.TEMPLATE
    neighbour_search: NeighbourSearch = NeighbourSearch.EVERY_LAYER
    cross_attention_basis_stride: int = 1
    """The cross-attention reads every n-th basis point."""
    embed_coordinates: bool = False
    """Add a learned embedding of the 3D coordinates to queries (every layer) and basis features (once)."""
    output: DecoderOutput = DecoderOutput.OFFSETS

    def __post_init__(self) -> None:
        require_counts(self, "num_layers", "ffn_expansion", most=MAX_LAYERS)
        require_counts(self, "num_heads", "num_neighbours", "cross_attention_basis_stride")
        require(0 <= self.dropout < 1, f"`dropout` must be in [0, 1); got {self.dropout}")
        require(
            self.layer is Design.PAPER or self.num_neighbours <= NUM_QUERIES,
            f"`num_neighbours` must not exceed the {NUM_QUERIES} queries; got {self.num_neighbours}",
        )

    @property
    def query_order(self) -> QueryOrder:
        """Layout of the 799 queries."""
        return QueryOrder.JOINTS_FIRST if self.layer is Design.RELEASE else QueryOrder.VERTICES_FIRST


@dataclass(frozen=True)
class JointDecoderConfig:
    """Layers that move the 21 joints before the template is posed by them (ours)."""

    num_layers: int = 2
    width: int = 128
    num_heads: int = 4
    num_blocks: int = 2
    """Attention blocks in every layer."""
    ffn_expansion: int = 2
    shells_m: tuple[float, ...] = (0.005, 0.01, 0.018, 0.03)
    """Radii of the shells of basis points about every joint, metres."""
    picked_features: int = 16
    """Numbers that a joint takes from the feature maps at its own place."""

    def __post_init__(self) -> None:
        require_counts(self, "num_layers", "num_blocks", "ffn_expansion", most=MAX_LAYERS)
        require_counts(self, "width", "num_heads", "picked_features")
        require(
            self.width % self.num_heads == 0,
            f"`width` must be a multiple of `num_heads` = {self.num_heads}; got {self.width}",
        )
        require(
            1 <= len(self.shells_m) <= MAX_LAYERS and all(0 < r < math.inf for r in self.shells_m),
            f"`shells_m` must name 1 to {MAX_LAYERS} positive radii, metres; got {self.shells_m}",
        )


@dataclass(frozen=True)
class CropConfig:
    """The pictures that a model was trained on."""

    ratio: float = 2.0
    """Side of the square crop over the longer side of the bounding box of the 21 joints."""
    upright: bool = False
    """Crops are rolled so that hands stand upright."""

    def __post_init__(self) -> None:
        require(0 < self.ratio < math.inf, f"`ratio` must be positive and finite; got {self.ratio}")


class GridDraw(NamedTuple):
    """Basis points that are drawn anew for every sample from the grids before the cameras."""

    num_points: int
    """How many are drawn."""
    points_per_view: int
    """Grid points of one camera."""
    about: str = "the hand"
    """What the ball lies about, in words, for messages."""


class ModelConfig:
    """What every system's configuration tells the code that runs them all (`network`, `apply`, `infer`, ...).

    The configs are frozen dataclasses that inherit from this class. A property below holds for most systems;
    one for which it does not overrides it.
    """

    image_hw: tuple[int, int]
    image_mean: float
    image_std: float
    crop: CropConfig

    @property
    def query_order(self) -> QueryOrder:
        """Layout of the 799 query points."""
        raise NotImplementedError(f"{type(self).__name__} must say its `query_order`")

    @property
    def triangulates(self) -> bool:
        """Whether the hand's place comes from rays of two views or more, of heat maps that the system has."""
        return False

    @property
    def takes_root(self) -> bool:
        """Whether `root_world` may be given; it then stands in for the triangulated root."""
        return False

    @property
    def needs_all_joints(self) -> bool:
        """Whether all 21 joints must be triangulated, not the root alone."""
        return False

    @property
    def grid_draw(self) -> GridDraw | None:
        """How basis points are drawn from the cameras' grids; None = they are not."""
        return None

    @property
    def view_range(self) -> tuple[int, int | None]:
        """Least and most views that the layers are made for, masked ones counted; None = any number."""
        return 1, None

    @property
    def views_in_words(self) -> str:
        """`view_range` for a message: "8", "1 to 8", "2 or more"."""
        least, most = self.view_range
        if most is None:
            return f"{least} or more"
        return f"{least}" if least == most else f"{least} to {most}"

    @property
    def couples_samples(self) -> bool:
        """Whether a sample's result depends on the other samples of its batch."""
        return False


@dataclass(frozen=True)
class Config(ModelConfig):
    """A whole POEM v2 model."""

    image_hw: tuple[int, int] = (256, 256)
    image_mean: float = 0.5
    image_std: float = 1.0
    crop: CropConfig = CropConfig()
    width: int = 256
    """Channels d of basis features and query embeddings."""
    backbone: HRNetConfig | ResNetConfig = field(default_factory=HRNetConfig)
    root: RootConfig = RootConfig()
    features: FeatureConfig = FeatureConfig()
    basis: BasisConfig = BasisConfig()
    aggregation: AggregationConfig = AggregationConfig()
    joint_decoder: JointDecoderConfig | None = None
    """None = the template is posed by the triangulated joints as they are, or stands about the root."""
    decoder: DecoderConfig = DecoderConfig()

    def __post_init__(self) -> None:
        require_counts(self, "image_hw", "width")
        require_images(self, self.backbone.strides)
        strides = self.backbone.strides
        for name, stride in (
            ("features.stride", self.features.stride),
            ("root.stride", self.root.stride),
            ("root.stride / root.pooling", self.root.branch_stride),
        ):
            require(stride in strides, f"`{name}` must be one of the trunk's strides {strides}; got {stride}")
        require(
            self.features.design is Design.PAPER or self.features.stride == strides[-2],
            f"`features.stride` must be {strides[-2]} with `features.design` = release, which enlarges the "
            f"trunk's coarsest map once; got {self.features.stride}",
        )
        require(
            not self.features.heat_maps
            or (
                self.features.design is self.root.design is Design.PAPER
                and self.features.stride == self.root.stride
            ),
            "`features.heat_maps` needs `features` and `root` of `design` = paper and of one `stride`; got "
            f"{self.features.design} of {self.features.stride} and {self.root.design} of {self.root.stride}",
        )
        require(
            self.width % (4 * self.decoder.num_heads) == 0,
            f"`width` must be a multiple of 4 x `num_heads` = {4 * self.decoder.num_heads}; got {self.width}",
        )
        require(
            self.decoder.num_neighbours <= self.basis.num_points,
            f"`num_neighbours` must not exceed the {self.basis.num_points} basis points; "
            f"got {self.decoder.num_neighbours}",
        )
        require(
            self.decoder.layer is Design.PAPER or self.basis.num_points >= NUM_QUERIES,
            f"`decoder.layer` = release names rows of the {NUM_QUERIES} queries and of the basis "
            f"alike, so `basis.num_points` must be at least {NUM_QUERIES}; got {self.basis.num_points}",
        )
        require(
            self.decoder.first_queries is FirstQueries.TEMPLATE or self.root.num_joints == NUM_JOINTS,
            f"`first_queries` = joints needs `root.num_joints` = {NUM_JOINTS}; got {self.root.num_joints}",
        )
        require(
            self.joint_decoder is None
            or (self.decoder.first_queries is FirstQueries.JOINTS and self.root.design is Design.PAPER),
            "`joint_decoder` moves the joints that pose the template, by maps of the paper's form: it needs "
            "`decoder.first_queries` = joints and `root.design` = paper",
        )

    @property
    def query_order(self) -> QueryOrder:
        """Layout of the 799 query points."""
        return self.decoder.query_order

    @property
    def triangulates(self) -> bool:
        """The root, at least, is triangulated."""
        return True

    @property
    def takes_root(self) -> bool:
        """A known root stands in for the triangulated one."""
        return True
