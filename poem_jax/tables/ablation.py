"""The paper's table "Quantitative results of the ablation study"; it has no row 5."""

from poem_jax.tables.main import POEM
from poem_jax.tables.models import v1
from poem_jax.tables.row import AT_20_MM, AT_50_MM, Row
from poem_jax.tables.splits import DEXYCB, HO3D, OAKINK
from poem_jax.tables.table import Table

_DEXYCB, _OAKINK, _HO3D = (DEXYCB, AT_20_MM, "dexycb"), (OAKINK, AT_20_MM, "oakink"), (HO3D, AT_50_MM, "ho3d")


def _row(number: int, on: tuple, label: str, model: str, *printed: float) -> Row:
    data, columns, dataset = on
    return Row(label, data, columns, printed, v1(model, dataset), number)


table = Table(
    "ablation",
    "Quantitative results of the ablation study",
    (
        _row(1, _DEXYCB, POEM, "v1", 6.13, 7.21, 4.00, 0.70, 6.06, 7.30, 3.93, 0.68),
        _row(2, _DEXYCB, "1stage", "v1-1stage", 9.42, 10.06, 5.84, 0.61, 9.27, 9.69, 5.22, 0.60),
        _row(3, _DEXYCB, "w/o-proj", "v1-wo-proj", 6.57, 7.69, 4.42, 0.68, 6.54, 7.82, 4.37, 0.67),
        _row(4, _DEXYCB, "w/o-pt", "v1-wo-pt", 7.63, 8.94, 5.48, 0.63, 7.20, 8.58, 4.89, 0.65),
        _row(6, _OAKINK, "POEM v1 (V-emb)", "v1", 6.20, 7.63, 4.21, 0.70, 6.01, 7.46, 4.00, 0.69),
        _row(7, _OAKINK, "G-emb", "v1-g-emb", 6.25, 7.65, 4.33, 0.70, 6.05, 7.66, 4.10, 0.69),
        _row(8, _OAKINK, "G&V-emb", "v1-gv-emb", 6.23, 7.63, 4.30, 0.70, 6.05, 7.65, 4.09, 0.69),
        _row(9, _OAKINK, "w/o-proj", "v1-wo-proj", 6.42, 7.82, 4.50, 0.69, 6.25, 7.84, 4.28, 0.68),
        _row(10, _HO3D, POEM, "v1", 17.20, 21.45, 9.97, 0.66, 17.28, 21.94, 9.60, 0.63),
        _row(11, _HO3D, "w/o-proj", "v1-wo-proj", 18.83, 22.26, 10.83, 0.63, 18.48, 22.73, 10.39, 0.63),
        _row(12, _HO3D, "w/o-pt", "v1-wo-pt", 19.26, 24.32, 12.45, 0.62, 18.20, 23.80, 10.56, 0.63),
    ),
)
