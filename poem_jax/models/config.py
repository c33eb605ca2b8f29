"""Configuration of a POEM model: frozen dataclasses nested by owner, and their JSON form.

A choice that the paper and other builds make differently is a named field of the part that has it.
Cross-field rules are checked on construction; unknown keys in a JSON text fail.
"""

import dataclasses
import enum
import json
import math
import types
import typing
from dataclasses import dataclass, field
from typing import Any, TypeVar

from poem_jax.hand.topology import NUM_JOINTS

_T = TypeVar("_T")
_KIND = "kind"


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _require_counts(owner: Any, *names: str) -> None:
    """Insist that fields are whole numbers from 1, or tuples of them."""
    for name in names:
        value = getattr(owner, name)
        entries = value if isinstance(value, tuple) else (value,)
        _require(
            all(type(entry) is int and entry >= 1 for entry in entries),
            f"`{name}` must be whole and at least 1; got {value}",
        )


class Stem(enum.StrEnum):
    """How a ResNet reaches a quarter of the image's resolution."""

    CONVOLUTION = "convolution"
    """7 x 7 convolution of stride 2, then 3 x 3 max pooling of stride 2 (He et al. 2016)."""
    SPACE_TO_DEPTH = "space_to_depth"
    """4 x 4 pixels become 48 channels, then one 3 x 3 convolution: far cheaper on a CPU."""


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
        _require_counts(self, "width", "stem_channels", "stem_blocks", "modules", "blocks")
        _require(len(self.modules) == 3, f"`modules` must name stages 2, 3 and 4; got {self.modules}")

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

    def __post_init__(self) -> None:
        _require(
            len(self.blocks) == len(self.channels) >= 1,
            f"`blocks` and `channels` must name the same stages; got {self.blocks} and {self.channels}",
        )
        _require_counts(self, "blocks", "channels", "stem_channels")

    @property
    def strides(self) -> tuple[int, ...]:
        """Strides of the feature maps, finest first."""
        return tuple(4 * 2**stage for stage in range(len(self.blocks)))

    @classmethod
    def resnet18(cls) -> "ResNetConfig":
        """The 18-layer network of the paper."""
        return cls(blocks=(2, 2, 2, 2), channels=(64, 128, 256, 512), bottleneck=False)

    @classmethod
    def resnet34(cls) -> "ResNetConfig":
        """The 34-layer network of the paper."""
        return cls(blocks=(3, 4, 6, 3), channels=(64, 128, 256, 512), bottleneck=False)

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
    activation: HeatActivation = HeatActivation.SIGMOID
    view_weights: ViewWeights = ViewWeights.EQUAL

    def __post_init__(self) -> None:
        _require(
            self.num_joints in (1, NUM_JOINTS),
            f"`num_joints` must be 1 (the root) or {NUM_JOINTS} (all joints); got {self.num_joints}",
        )


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
        _require_counts(self, "num_points")
        _require(
            0 < self.radius < math.inf, f"`radius` must be positive and finite, metres; got {self.radius}"
        )


class Similarity(enum.StrEnum):
    """Weight of a source view in the projective aggregation."""

    DOT = "dot"
    """theta(f1) . theta(fj), as the paper writes it."""
    MEAN = "mean"
    """The same divided by its number of terms, so that its size does not grow with the width."""


class NeighbourSearch(enum.StrEnum):
    """When the nearest basis points of the queries are looked up."""

    EVERY_LAYER = "every_layer"
    ONCE = "once"


class QueryStart(enum.StrEnum):
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
    query_start: QueryStart = QueryStart.TEMPLATE
    neighbour_search: NeighbourSearch = NeighbourSearch.EVERY_LAYER
    cross_attention_basis_stride: int = 1
    """The cross-attention reads every n-th basis point."""
    embed_coordinates: bool = False
    """Add a learned embedding of the 3D coordinates to queries (every layer) and basis features (once)."""
    output: DecoderOutput = DecoderOutput.OFFSETS

    def __post_init__(self) -> None:
        _require_counts(
            self, "num_layers", "num_heads", "num_neighbours", "ffn_expansion", "cross_attention_basis_stride"
        )


@dataclass(frozen=True)
class Config:
    """A whole model."""

    image_hw: tuple[int, int] = (256, 256)
    image_mean: float = 0.5
    image_std: float = 1.0
    width: int = 256
    """Channels d of basis features and query embeddings."""
    feature_stride: int = 8
    """Pixels per cell of the feature maps that the basis points sample."""
    backbone: HRNetConfig | ResNetConfig = field(default_factory=HRNetConfig)
    root: RootConfig = RootConfig()
    basis: BasisConfig = BasisConfig()
    similarity: Similarity = Similarity.DOT
    decoder: DecoderConfig = DecoderConfig()

    def __post_init__(self) -> None:
        _require_counts(self, "image_hw", "width")
        _require(
            isinstance(self.image_hw, tuple) and len(self.image_hw) == 2,
            f"`image_hw` must be (height, width); got {self.image_hw}",
        )
        _require(
            math.isfinite(self.image_mean) and 0 < self.image_std < math.inf,
            f"`image_mean` must be finite and `image_std` positive; got {self.image_mean}, {self.image_std}",
        )
        coarsest = self.backbone.strides[-1]
        _require(
            all(size % coarsest == 0 for size in self.image_hw),
            f"`image_hw` must be multiples of the trunk's coarsest stride {coarsest}; got {self.image_hw}",
        )
        for name, stride in (("feature_stride", self.feature_stride), ("root.stride", self.root.stride)):
            _require(
                stride in self.backbone.strides,
                f"`{name}` must be one of the trunk's strides {self.backbone.strides}; got {stride}",
            )
        _require(
            self.width % (4 * self.decoder.num_heads) == 0,
            f"`width` must be a multiple of 4 x `num_heads` = {4 * self.decoder.num_heads}; got {self.width}",
        )
        _require(
            self.decoder.num_neighbours <= self.basis.num_points,
            f"`num_neighbours` must not exceed the {self.basis.num_points} basis points; "
            f"got {self.decoder.num_neighbours}",
        )
        _require(
            self.decoder.query_start is QueryStart.TEMPLATE or self.root.num_joints == NUM_JOINTS,
            f"`query_start` = joints needs `root.num_joints` = {NUM_JOINTS}; got {self.root.num_joints}",
        )


def to_json(config: Config) -> str:
    """Write a config as JSON text; dataclasses that are one of several carry their class name as `kind`."""
    return json.dumps(_encode(config, Config), indent=2)


def from_json(text: str) -> Config:
    """Read a config from JSON text.

    Raises:
        ValueError: unknown key, missing or unknown `kind`, a value of the wrong type, or one that breaks a
            rule of its dataclass.
    """
    return _decode(json.loads(text), Config, "config")


def _encode(value: Any, declared: Any) -> Any:
    if dataclasses.is_dataclass(value):
        hints = typing.get_type_hints(type(value))
        entries = {f.name: _encode(getattr(value, f.name), hints[f.name]) for f in dataclasses.fields(value)}
        return {_KIND: type(value).__name__, **entries} if _is_union(declared) else entries
    return list(value) if isinstance(value, tuple) else value


def _decode(value: Any, declared: Any, path: str) -> Any:
    if _is_union(declared):
        return _decode_union(value, declared, path)
    if dataclasses.is_dataclass(declared):
        return _decode_dataclass(value, typing.cast(type, declared), path)
    if typing.get_origin(declared) is tuple:
        return _decode_tuple(value, typing.get_args(declared), path)
    if issubclass(declared, enum.Enum):
        return declared(value)
    # A bool is an int to Python; a whole number is a good float.
    accepted = (int, float) if declared is float else (declared,)
    _require(type(value) in accepted, f"`{path}` must be of type {declared.__name__}; got {value!r}")
    return declared(value)


def _decode_tuple(value: Any, entries: tuple[Any, ...], path: str) -> tuple[Any, ...]:
    _require(isinstance(value, list), f"`{path}` must be a list; got {value!r}")
    if entries[-1] is Ellipsis:
        entries = entries[:1] * len(value)
    _require(len(value) == len(entries), f"`{path}` must have {len(entries)} entries; got {value!r}")
    return tuple(
        _decode(v, declared, f"{path}.{i}")
        for i, (v, declared) in enumerate(zip(value, entries, strict=True))
    )


def _decode_union(value: Any, declared: Any, path: str) -> Any:
    _require(isinstance(value, dict), f"`{path}` must be an object; got {value!r}")
    options = {option.__name__: option for option in typing.get_args(declared)}
    kind = value.get(_KIND)
    if kind not in options:
        raise ValueError(f"`{path}.{_KIND}` must be one of {sorted(options)}; got {kind!r}")
    return _decode_dataclass({k: v for k, v in value.items() if k != _KIND}, options[kind], path)


def _decode_dataclass(value: Any, declared: type[_T], path: str) -> _T:
    _require(isinstance(value, dict), f"`{path}` must be an object; got {value!r}")
    hints = typing.get_type_hints(declared)
    unknown = sorted(set(value) - set(hints))
    if unknown:
        raise ValueError(f"`{path}` has unknown keys {unknown}; known are {sorted(hints)}")
    return declared(**{key: _decode(entry, hints[key], f"{path}.{key}") for key, entry in value.items()})


def _is_union(declared: Any) -> bool:
    return isinstance(declared, types.UnionType)
