"""Configuration of POEM v1 (the paper's conference model) and of its ablations.

`design` says whether feature maps, basis features, query embeddings and decoder are the paper's or the
release's; the fields beside it are what the ablations vary. The paper's models have the depths and the cuboid
of DexYCB, the only ones that it names; `in_cuboid` gives the same model those of another data set.
"""

import enum
import math
from dataclasses import dataclass, field, replace

from poem_jax.hand.topology import NUM_JOINTS, NUM_QUERIES, QueryOrder
from poem_jax.models.config import (
    MAX_LAYERS,
    CropConfig,
    Design,
    FrozenNorms,
    GridDraw,
    ModelConfig,
    ResNetConfig,
    RootConfig,
    require,
    require_counts,
    require_images,
)
from poem_jax.models.detr_config import DetrConfig
from poem_jax.models.frustum_config import DEXYCB_CUBOID, Cuboid, DepthSteps, FrustumConfig
from poem_jax.models.mesh_transformer_config import MeshTransformerConfig, PositionEmbeddedFusion


@dataclass(frozen=True)
class OneStageConfig:
    """No first stage: query points start at learned places, basis points lie about a fixed one (paper,
    "Two-stage Design", POEM v1-1stage)."""

    origin: tuple[float, float, float] = (0.0, 0.0, 0.8)
    """Mean root joint of the training set in the primary camera's frame, metres
    (`training.mean_root.mean_root`); what stands here is a guess."""

    def __post_init__(self) -> None:
        require(
            isinstance(self.origin, tuple)
            and len(self.origin) == 3
            and all(math.isfinite(metres) for metres in self.origin),
            f"`origin` must be three finite numbers (x, y, z); got {self.origin}",
        )


@dataclass(frozen=True)
class RootSpace:
    """The second stage works in coordinates about the root, in units of the ball's radius (paper)."""


@dataclass(frozen=True)
class BallConfig:
    """Basis points: those of the cameras' frustum grids that lie in a ball, in random order."""

    num_points: int = 4096
    radius: float = 0.1
    """Metres. The paper's ball has a diameter of 20 cm, the release's a radius of 20 cm."""
    frustum: FrustumConfig = FrustumConfig()

    def __post_init__(self) -> None:
        require_counts(self, "num_points")
        require(
            0 < self.radius < math.inf, f"`radius` must be positive and finite, metres; got {self.radius}"
        )


class BasisFeatures(enum.StrEnum):
    """Where the features of the basis points come from."""

    PROJECTED = "projected"
    """Sampled in every view where the point projects, and fused by projective aggregation."""
    OWN_CAMERA = "own_camera"
    """From the cell of the one camera in whose grid the point stands (POEM v1-w/o-proj)."""


class QueryEmbedding(enum.StrEnum):
    """What the embeddings of the query points are made of (paper, "Query's Learnable Embeddings
    Selection")."""

    VERTEX = "vertex"
    """V-emb: a learned table."""
    GLOBAL = "global"
    """G-emb: a global image feature beside the point's place on the template."""
    GLOBAL_AND_VERTEX = "global_and_vertex"
    """G&V-emb: the global image feature plus the table."""
    POINTS = "points"
    """The release's query type "POEM": the table beside the first query point and its place on the
    template."""
    POINT_CODES = "point_codes"
    """The same with sines of the table's first three numbers in place of the table (the release without
    projection)."""

    @property
    def is_release_only(self) -> bool:
        """Whether the paper has no such embedding."""
        return self in (QueryEmbedding.POINTS, QueryEmbedding.POINT_CODES)


@dataclass(frozen=True)
class PointDecoderConfig:
    """Point-embedded decoder. The paper's layers: self-attention, vector attention to the basis, feed-forward
    network. The release's: vector attention among the queries and to the basis, then an offset."""

    num_layers: int = 6
    num_neighbours: int = 16
    num_heads: int = 4
    """Of the paper's self-attention."""
    ffn_expansion: int = 4
    """Hidden width of the paper's feed-forward network over the width of the embeddings."""

    def __post_init__(self) -> None:
        require_counts(self, "num_layers", most=MAX_LAYERS)
        require_counts(self, "num_neighbours", "num_heads", "ffn_expansion")
        require(
            self.num_neighbours <= NUM_QUERIES,
            f"`num_neighbours` must not exceed the {NUM_QUERIES} queries; got {self.num_neighbours}",
        )


@dataclass(frozen=True)
class TokenDecoderConfig:
    """PE-MeshTR's decoder: queries read the cells of all views, which are told where they stand, in place of
    basis points (paper, "Point Cloud Embedding", POEM v1-w/o-pt)."""

    detr: DetrConfig = DetrConfig()
    cuboid: Cuboid = DEXYCB_CUBOID
    """Of which the places of the cells' grid points are told as shares."""

    @property
    def num_heads(self) -> int:
        """Of its attentions."""
        return self.detr.num_heads


@dataclass(frozen=True)
class PoemV1Config(ModelConfig):
    """A whole POEM v1."""

    image_hw: tuple[int, int] = (256, 256)
    image_mean: float = 0.5
    image_std: float = 1.0
    crop: CropConfig = CropConfig()
    width: int = 256
    """Channels d of basis features and query embeddings."""
    backbone: ResNetConfig = field(default_factory=ResNetConfig.resnet34)
    design: Design = Design.PAPER
    first_stage: RootConfig | OneStageConfig = RootConfig(num_joints=NUM_JOINTS)
    """Heat maps and triangulation of all joints; or none."""
    space: RootSpace | Cuboid = RootSpace()
    """Coordinates in which the second stage works."""
    basis: BallConfig = BallConfig()
    """Without a point decoder only its frustum grids are used."""
    basis_features: BasisFeatures = BasisFeatures.PROJECTED
    query_embedding: QueryEmbedding = QueryEmbedding.VERTEX
    decoder: PointDecoderConfig | TokenDecoderConfig = PointDecoderConfig()

    def __post_init__(self) -> None:
        require_counts(self, "image_hw", "width")
        require_images(self, self.backbone.strides)
        self._check_first_stage()
        self._check_second_stage()

    def _check_first_stage(self) -> None:
        first, strides = self.first_stage, self.backbone.strides
        if isinstance(first, OneStageConfig):
            require(
                self.design is Design.PAPER and isinstance(self.space, Cuboid),
                "one stage needs `design` = paper and a cuboid for its `space`, since there is no root; got "
                f"{self.design} and {type(self.space).__name__}",
            )
        else:
            require(
                first.num_joints == NUM_JOINTS and first.design is self.design,
                f"`first_stage` must have {NUM_JOINTS} joints and the `design` of the whole; got "
                f"{first.num_joints} and {first.design} in {self.design}",
            )
        for stride in {self.stride, self.branch_stride}:
            require(stride in strides, f"the branches must end at one of the strides {strides}; got {stride}")

    def _check_second_stage(self) -> None:
        decoder, is_release = self.decoder, self.design is Design.RELEASE
        require(
            not is_release or (isinstance(self.space, Cuboid) and isinstance(decoder, PointDecoderConfig)),
            "`design` = release needs a cuboid for its `space` and a point decoder; got "
            f"{type(self.space).__name__} and {type(decoder).__name__}",
        )
        require(
            is_release or not self.query_embedding.is_release_only,
            f"`query_embedding` = {self.query_embedding} needs `design` = release",
        )
        own_camera = self.basis_features is BasisFeatures.OWN_CAMERA
        require(
            not is_release or own_camera == (self.query_embedding is QueryEmbedding.POINT_CODES),
            "with `design` = release, `basis_features` = own_camera and `query_embedding` = point_codes go "
            f"together; got {self.basis_features} and {self.query_embedding}",
        )
        require(
            self.width % (4 * decoder.num_heads) == 0,
            f"`width` must be a multiple of 4 x `num_heads` = {4 * decoder.num_heads}; got {self.width}",
        )
        depths = self.basis.frustum.num_depths
        require(
            self.basis_features is BasisFeatures.PROJECTED or self.width % depths == 0,
            f"`width` must be a multiple of the {depths} depths, each of which has its share of a cell's "
            f"channels; got {self.width}",
        )
        if isinstance(decoder, TokenDecoderConfig):
            require(
                not own_camera,
                "`basis_features` must be projected where `decoder` reads tokens, since there are no basis "
                f"points; got {self.basis_features}",
            )
            self.as_mesh_transformer(decoder)
        else:
            require(
                decoder.num_neighbours <= self.basis.num_points <= self._points_per_view,
                f"`basis.num_points` must be from `num_neighbours` = {decoder.num_neighbours} to the "
                f"{self._points_per_view} grid points of one view; got {self.basis.num_points}",
            )

    @property
    def query_order(self) -> QueryOrder:
        """Layout of the 799 queries."""
        return QueryOrder.JOINTS_FIRST if self.design is Design.RELEASE else QueryOrder.VERTICES_FIRST

    @property
    def stride(self) -> int:
        """Pixels per cell of heat maps, feature maps and frustum grids."""
        return self.first_stage.stride if isinstance(self.first_stage, RootConfig) else 8

    @property
    def branch_stride(self) -> int:
        """Pixels per cell where the feature branch ends, before it is pooled (release)."""
        return self.stride // self.pooling

    @property
    def pooling(self) -> int:
        """The feature branch ends so many times finer than its map."""
        return 2 if self.design is Design.RELEASE else 1

    @property
    def map_hw(self) -> tuple[int, int]:
        """Cells of the feature map."""
        return self.image_hw[0] // self.stride, self.image_hw[1] // self.stride

    def as_mesh_transformer(self, decoder: TokenDecoderConfig) -> MeshTransformerConfig:
        """Return the PE-MeshTR whose fusion and decoder these are.

        Raises:
            ValueError: sizes that it cannot have.
        """
        return MeshTransformerConfig(
            fusion=PositionEmbeddedFusion(self.basis.frustum),
            image_hw=self.image_hw,
            width=self.width,
            backbone=self.backbone,
            stride=self.stride,
            cuboid=decoder.cuboid,
            decoder=decoder.detr,
        )

    @property
    def _points_per_view(self) -> int:
        return self.map_hw[0] * self.map_hw[1] * self.basis.frustum.num_depths

    @property
    def triangulates(self) -> bool:
        """Whether the hand's place comes from rays of two views or more."""
        return isinstance(self.first_stage, RootConfig)

    @property
    def takes_root(self) -> bool:
        """Only the paper's two stages work about a root; one stage and the release have no use for it."""
        return self.triangulates and self.design is Design.PAPER

    @property
    def needs_all_joints(self) -> bool:
        """The paper's model starts joints that it cannot triangulate at the root; the release does not."""
        return self.triangulates and self.design is Design.RELEASE

    @property
    def grid_draw(self) -> GridDraw | None:
        """How basis points are drawn from the cameras' grids; None = PE-MeshTR's decoder needs none."""
        if not isinstance(self.decoder, PointDecoderConfig):
            return None
        if isinstance(self.first_stage, OneStageConfig):
            about = f"`first_stage.origin` = {self.first_stage.origin}, metres before the primary camera"
        else:
            about = "the hand's root joint" if self.takes_root else "the triangulated hand"
        return GridDraw(self.basis.num_points, self._points_per_view, about)


V1 = PoemV1Config()
"""The paper's."""


def one_stage(origin: tuple[float, float, float], cuboid: Cuboid = DEXYCB_CUBOID) -> PoemV1Config:
    """Return the ablation without a first stage; `origin` is the mean root of the training set, metres in
    the primary camera's frame."""
    return in_cuboid(PoemV1Config(first_stage=OneStageConfig(origin), space=cuboid), cuboid)


def in_cuboid(config: PoemV1Config, cuboid: Cuboid) -> PoemV1Config:
    """Return the same model for hands elsewhere, for example in `presets.CUBOIDS["ho3d"]`: the depths of its
    grids are those of the cuboid, and so are the shares that its coordinates are, where they are any."""
    frustum = replace(config.basis.frustum, start=cuboid.low[2], end=cuboid.high[2])
    decoder = config.decoder
    return replace(
        config,
        basis=replace(config.basis, frustum=frustum),
        space=cuboid if isinstance(config.space, Cuboid) else config.space,
        decoder=replace(decoder, cuboid=cuboid) if isinstance(decoder, TokenDecoderConfig) else decoder,
    )


def released(
    cuboid: Cuboid,
    query_embedding: QueryEmbedding = QueryEmbedding.VERTEX,
    basis_features: BasisFeatures = BasisFeatures.PROJECTED,
) -> PoemV1Config:
    """Return a released model; the depths of its grids are those of its cuboid."""
    depths = FrustumConfig(32, cuboid.low[2], cuboid.high[2], DepthSteps.LINEAR, cell_offset=0.0)
    return PoemV1Config(
        backbone=ResNetConfig.resnet34(FrozenNorms.STAGE_STARTS),
        design=Design.RELEASE,
        first_stage=RootConfig(NUM_JOINTS, design=Design.RELEASE),
        space=cuboid,
        basis=BallConfig(radius=0.2, frustum=depths),
        basis_features=basis_features,
        query_embedding=query_embedding,
    )
