"""Configuration of the mesh transformers, PE-MeshTR and FTL-MeshTR (`mesh_transformers.py`), and the released
ones."""

from dataclasses import dataclass, field, replace

from poem_jax.hand.topology import QueryOrder
from poem_jax.models.config import (
    CropConfig,
    Design,
    FrozenNorms,
    ModelConfig,
    ResNetConfig,
    require,
    require_counts,
    require_images,
)
from poem_jax.models.detr_config import DetrConfig
from poem_jax.models.frustum_config import (
    CUBOIDS,
    DEXYCB_CUBOID,
    Cuboid,
    DepthSteps,
    FrustumConfig,
)

_MIN_POINT_CHANNELS = 6
"""A sine and a cosine of x, y and z."""


@dataclass(frozen=True)
class PositionEmbeddedFusion:
    """PE-MeshTR: features are told where their points lie in the world."""

    frustum: FrustumConfig = FrustumConfig()


@dataclass(frozen=True)
class CanonicalFusion:
    """FTL-MeshTR: features are read as 3D points, and moved by the cameras."""

    num_points: int = 32
    """Points per cell of the map: a third of its channels."""
    num_views: int = 8
    """Most views of a sample in the paper's design, whose last convolution has weights for each. The
    release's design takes any number."""

    def __post_init__(self) -> None:
        require_counts(self, "num_points", "num_views")


@dataclass(frozen=True)
class MeshTransformerConfig(ModelConfig):
    """A whole mesh transformer."""

    design: Design = Design.PAPER
    """What differs between paper and release, `mesh_transformers.py` says part by part."""
    fusion: PositionEmbeddedFusion | CanonicalFusion = PositionEmbeddedFusion()
    image_hw: tuple[int, int] = (256, 256)
    image_mean: float = 0.5
    image_std: float = 1.0
    crop: CropConfig = CropConfig()
    width: int = 256
    """Channels d of tokens and query embeddings."""
    backbone: ResNetConfig = field(default_factory=ResNetConfig.resnet34)
    stride: int = 8
    """Pixels per cell of the map whose cells are the tokens."""
    cuboid: Cuboid = DEXYCB_CUBOID
    """Where query points can be."""
    decoder: DetrConfig = DetrConfig()

    def __post_init__(self) -> None:
        require_counts(self, "image_hw", "width", "stride")
        strides = self.backbone.strides
        require_images(self, strides)
        require(
            self.stride in strides,
            f"`stride` must be one of the trunk's strides {strides}; got {self.stride}",
        )
        require(
            self.design is Design.PAPER or self.stride == strides[-1],
            "`backbone` must end at `stride` with `design` = release, which reads nothing coarser; got the "
            f"strides {strides} and `stride` = {self.stride}",
        )
        require(self.width % 4 == 0, f"`width` must be a multiple of 4; got {self.width}")
        require(
            self.width % self.decoder.num_heads == 0,
            f"`width` must be a multiple of `num_heads` = {self.decoder.num_heads}; got {self.width}",
        )
        if isinstance(self.fusion, PositionEmbeddedFusion) and self.design is Design.PAPER:
            depths = self.fusion.frustum.num_depths
            require(
                self.width % (2 * depths) == 0 and self.width >= _MIN_POINT_CHANNELS * depths,
                f"`width` must give each of the {depths} points along a ray an even number of channels, at "
                f"least {_MIN_POINT_CHANNELS}, with `design` = paper; got {self.width}",
            )

    @property
    def query_order(self) -> QueryOrder:
        """Layout of the 799 queries."""
        return QueryOrder.JOINTS_FIRST if self.design is Design.RELEASE else QueryOrder.VERTICES_FIRST

    @property
    def view_range(self) -> tuple[int, int | None]:
        """The paper's canonical fusion has weights for each view; the others take any number."""
        if isinstance(self.fusion, CanonicalFusion) and self.design is Design.PAPER:
            return 1, self.fusion.num_views
        return 1, None


PE_MESHTR = MeshTransformerConfig(fusion=PositionEmbeddedFusion())
FTL_MESHTR = MeshTransformerConfig(fusion=CanonicalFusion())
"""As the paper describes them."""


def pe_meshtr_release(dataset: str = "dexycb") -> MeshTransformerConfig:
    """Return the released PE-MeshTR of a data set."""
    cuboid = _cuboid_of(dataset)
    frustum = FrustumConfig(64, cuboid.low[2], cuboid.high[2], DepthSteps.LINEAR_INCREASING, cell_offset=0.0)
    return MeshTransformerConfig(
        design=Design.RELEASE,
        fusion=PositionEmbeddedFusion(frustum),
        # What lies behind stage 2 reaches no output and is left out.
        backbone=replace(ResNetConfig.resnet34(FrozenNorms.STAGE_STARTS), blocks=(3, 4), channels=(64, 128)),
        cuboid=cuboid,
    )


def ftl_meshtr_release(dataset: str = "dexycb") -> MeshTransformerConfig:
    """Return the released FTL-MeshTR of a data set."""
    return replace(pe_meshtr_release(dataset), fusion=CanonicalFusion())


def _cuboid_of(dataset: str) -> Cuboid:
    require(dataset in CUBOIDS, f"`dataset` must be one of {', '.join(CUBOIDS)}; got {dataset!r}")
    return CUBOIDS[dataset]
