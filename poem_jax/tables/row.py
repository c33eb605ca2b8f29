"""A row of a table as data: what is scored, on what, how, and what the paper has there."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from poem_jax.data.view_sampling import AllViews, UniformViews, ViewSampling
from poem_jax.evaluation.dataset import Change
from poem_jax.evaluation.keypoint_fitting import Solver
from poem_jax.tables.places import Places
from poem_jax.tables.splits import OwnCapture, Split

AT_20_MM = (
    *("mpvpe_mm", "rr_mpvpe_mm", "pa_mpvpe_mm", "auc_v_20"),
    *("mpjpe_mm", "rr_mpjpe_mm", "pa_mpjpe_mm", "auc_j_20"),
)
"""Columns of the paper's wide tables."""
AT_50_MM = tuple(name.replace("_20", "_50") for name in AT_20_MM)
"""The same for HO3D-Mv."""
OFFICIAL = ("pa_mpjpe_mm", "pa_auc_j_50", "pa_mpvpe_mm", "pa_auc_v_50", "pa_f_5", "pa_f_15")
"""Of HO-3D's official evaluation; all after Procrustes alignment."""
SHORT = ("mpvpe_mm", "pa_mpvpe_mm", "mpjpe_mm", "pa_mpjpe_mm")
AS_POEM, AS_PREDICTED = "poem-release", "poem"
"""The protocols of POEM's tables. MPJPE of POEM is of joints regressed from the mesh; that of the baselines
and of key-point fits of the joints that they predict, against the annotated ones."""


@dataclass(frozen=True)
class Checkpoint:
    """A model folder below the folder of checkpoints."""

    name: str
    preset: str
    """Whose system it must hold (`same_system`)."""
    made_by: tuple[str, ...]
    """Commands that make it, any of them; `{out}` is its folder, `{mano}` the user's MANO file."""

    def ways(self, places: Places) -> list[str]:
        """Return the commands as they are to be typed."""
        out = str(places.checkpoints / self.name)
        return [way.format(out=out, mano=places.mano) for way in self.made_by]


@dataclass(frozen=True)
class Shipped:
    """The weights that come with the package."""


@dataclass(frozen=True)
class Fitting:
    """Key-point fitting without masks: the hand is MANO's where the user has it."""

    solver: Solver
    keypoints: str | None = None
    """File of key points below the data's folder, taken where it is there (`evaluation.keypoint_fitting`);
    else, and for None, our detector looks for them."""


@dataclass(frozen=True)
class Quoted:
    """A number of the paper's alone, of a method that is not built here."""


@dataclass(frozen=True)
class Row:
    """One row."""

    label: str
    data: Split | OwnCapture
    columns: tuple[str, ...]
    """Metrics, as `evaluate` names them."""
    printed: tuple[float | None, ...] = ()
    """The paper's numbers in these columns, None where it has a dash; () = a row that the paper has not."""
    system: Checkpoint | Shipped | Fitting | Quoted = field(default_factory=Quoted)
    number: int | None = None
    """In the paper's table."""
    cameras: ViewSampling = AllViews()
    protocol: str = AS_POEM
    given_root: bool = False
    official: bool = False
    """HO-3D's evaluation: every image counts, and a submission is written."""
    change: Change | None = None
    """What is done to the cameras."""
    against: str | None = None
    """Label of the row above, on the same data, that this one is to be compared with: `% degrade`."""
    note: str = ""

    def __post_init__(self) -> None:
        if self.printed and len(self.printed) != len(self.columns):
            raise ValueError(
                f"{self.label}: {len(self.columns)} columns need as many printed numbers; got {self.printed}"
            )

    @property
    def paper(self) -> Mapping[str, float]:
        """The paper's numbers by metric."""
        pairs = zip(self.columns, self.printed, strict=False)
        return {name: value for name, value in pairs if value is not None}

    @property
    def num_views(self) -> int | None:
        """Of every sample, where the rule fixes it: a point of the curve over numbers of views."""
        rule = self.cameras
        return rule.min if isinstance(rule, UniformViews) and rule.min == rule.max else None
