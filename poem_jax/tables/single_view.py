"""The paper's number for a single view: sequence SM1 of HO-3D v2 with the true root (section Discussion)."""

from poem_jax.tables.models import v2
from poem_jax.tables.row import Row
from poem_jax.tables.splits import HO3D_SM1
from poem_jax.tables.table import Table

_COLUMNS = ("pa_mpjpe_mm", "pa_mpvpe_mm")

table = Table(
    "single-view",
    "One view with the true root",
    (
        Row(
            "POEM v2",
            HO3D_SM1,
            _COLUMNS,
            (7.4, 7.9),
            v2("v2-base"),
            protocol="ho3d",
            given_root=True,
            note="joint 9 of the labels is given",
        ),
        Row(
            "POEM v2-large",
            HO3D_SM1,
            _COLUMNS,
            (),
            v2("v2-large"),
            protocol="ho3d",
            given_root=True,
            note="not in the paper; joint 9 of the labels is given",
        ),
    ),
)
