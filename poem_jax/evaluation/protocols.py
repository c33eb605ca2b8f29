"""What the official evaluators do, as data: units, thresholds, and the metrics that each one has.

Sources: FreiHAND `eval.py` (lmb-freiburg/freihand), HO-3D `eval.py` (shreyashampali/ho3d), DexYCB
`hpe_eval.py` (NVlabs/dex-ycb-toolkit), POEM-v2 `lib/metrics` (JubSteven/POEM-v2).

A protocol says how points are compared, not which points: the joints are the caller's. `poem-release` alone
regresses them from the vertices of both sides, as the released POEM does, for all but the joints' areas.
"""

from dataclasses import dataclass

import numpy as np

from poem_jax.typing import Float

MM_PER_METRE = 1000.0
AUC_LIMITS_MM = (20, 50)
"""Upper ends of the threshold ranges of the paper's AUC columns."""
F_THRESHOLDS_MM = (5, 15)
SCALE_JOINT = 4
"""Its distance to joint 0 fixes the scale of HO-3D's scale-translation alignment, in any joint order."""
PROCRUSTES_EPSILON = 1e-8
"""Added to both norms by all four evaluators; in the unit of the data, so `units_per_metre` matters."""
NO_SCORE = -1.0
"""What FreiHAND and HO-3D report for vertex errors of a mesh that does not correspond to the ground truth."""


@dataclass(frozen=True)
class Protocol:
    """The choices in which the official evaluators differ."""

    name: str
    units_per_metre: int
    """Unit of its inputs: 1 (metres) or 1000 (millimetres); the Procrustes epsilon is in this unit."""
    auc_steps: int
    """Number of thresholds, both ends (0 and the limit) included."""
    has_f_scores: bool = False
    has_scale_translation: bool = False
    accepts_other_meshes: bool = False
    """Whether a predicted mesh of another vertex count is scored (F only) instead of refused."""
    regresses_joints: bool = False
    """Whether joint errors are of joints regressed from both meshes; areas stay those of the joints given."""

    def auc_thresholds(self, limit_mm: int) -> Float[np.ndarray, " step"]:
        """Return the thresholds of the PCK curve up to `limit_mm`, in the protocol's own unit."""
        return np.linspace(0.0, limit_mm / self.mm_per_unit, self.auc_steps)

    @property
    def mm_per_unit(self) -> float:
        """Millimetres in one of the protocol's own units."""
        return MM_PER_METRE / self.units_per_metre


PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol("poem", units_per_metre=1, auc_steps=20, has_f_scores=True),
        Protocol("poem-release", units_per_metre=1, auc_steps=20, has_f_scores=True, regresses_joints=True),
        Protocol("freihand", units_per_metre=1, auc_steps=100, has_f_scores=True, accepts_other_meshes=True),
        Protocol(
            "ho3d",
            units_per_metre=1,
            auc_steps=100,
            has_f_scores=True,
            has_scale_translation=True,
            accepts_other_meshes=True,
        ),
        Protocol("dexycb", units_per_metre=1000, auc_steps=100),
    )
}
"""By name. The F scores of `poem` are those of the paper's HO-3D tables; the release itself has none."""


def find_protocol(name: str) -> Protocol:
    """Return the protocol called `name`.

    Raises:
        ValueError: there is none; the message lists those that exist.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"`protocol` must be one of {', '.join(map(repr, PROTOCOLS))}; got {name!r}")
    return PROTOCOLS[name]
