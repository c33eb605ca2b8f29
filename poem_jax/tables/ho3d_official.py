"""The paper's tables on HO-3D's official evaluation, versions 2 and 3, beside methods of a single view.

POEM sees all cameras that the evaluation set has of an instant (AP1 and MPM1: five, SB1: two), the others
see one. SM1 has one camera, and the true root is given there.
"""

from poem_jax.tables.models import v2
from poem_jax.tables.row import OFFICIAL, Row
from poem_jax.tables.splits import HO3D_V2_OFFICIAL, HO3D_V3_OFFICIAL, Split
from poem_jax.tables.table import Table

_NOTES = (
    "Protocol of the official `eval.py`: every image counts once; F scores and areas are after Procrustes "
    "alignment. Other methods' numbers are those that the paper prints.",
)
_SM1 = "one camera in SM1: the true root is given there"


def _quoted(data: Split, label: str, *printed: float | None) -> Row:
    return Row(label, data, OFFICIAL, printed)


def _ours(data: Split, *printed: float) -> Row:
    return Row(
        "POEM v2-large", data, OFFICIAL, printed, v2("v2-large"), protocol="ho3d", official=True, note=_SM1
    )


_V2, _V3 = HO3D_V2_OFFICIAL, HO3D_V3_OFFICIAL
version_2 = Table(
    "ho3d-v2",
    "Comparison with single-view methods on HO-3D v2's official benchmark",
    (
        _quoted(_V2, "Pose2Mesh", 12.5, 0.754, 12.7, 0.749, 0.441, 0.909),
        _quoted(_V2, "ArtiBoost", 11.4, 0.773, 10.9, 0.782, 0.488, 0.944),
        _quoted(_V2, "I2L-MeshNet", 11.2, 0.775, 13.9, 0.722, 0.409, 0.932),
        _quoted(_V2, "Hasson et al.", 11.0, 0.780, 11.2, 0.777, 0.464, 0.939),
        _quoted(_V2, "Keypoint Trans", 10.8, 0.786, None, None, None, None),
        _quoted(_V2, "Hampali et al.", 10.7, 0.788, 10.6, 0.790, 0.506, 0.942),
        _quoted(_V2, "METRO", 10.4, 0.792, 11.1, 0.779, 0.484, 0.946),
        _quoted(_V2, "Liu et al.", 9.9, 0.803, 9.5, 0.810, 0.528, 0.956),
        _quoted(_V2, "I2UV-HandNet", 9.9, 0.804, 10.1, 0.799, 0.500, 0.943),
        _quoted(_V2, "MobRecon", 9.2, None, 9.4, None, 0.538, 0.957),
        _quoted(_V2, "HandOccNet", 9.1, 0.819, 8.8, 0.819, 0.564, 0.963),
        _quoted(_V2, "AMVUR", 8.3, 0.835, 8.2, 0.836, 0.608, 0.965),
        _quoted(_V2, "HandBooster", 8.2, 0.836, 8.4, 0.832, 0.585, 0.972),
        _quoted(_V2, "HaMeR", 7.7, 0.846, 7.9, 0.841, 0.635, 0.980),
        _quoted(_V2, "Hamba", 7.5, 0.850, 7.7, 0.846, 0.648, 0.982),
        _ours(_V2, 6.3, 0.874, 7.2, 0.856, 0.666, 0.989),
    ),
    _NOTES,
)
version_3 = Table(
    "ho3d-v3",
    "Comparison with single-view methods on HO-3D v3's official benchmark",
    (
        _quoted(_V3, "S2HAND", 11.5, 0.769, 11.1, 0.778, 0.448, 0.932),
        _quoted(_V3, "Keypoint Trans", 10.9, 0.785, None, None, None, None),
        _quoted(_V3, "ArtiBoost", 10.8, 0.785, 10.4, 0.792, 0.507, 0.946),
        _quoted(_V3, "AMVUR", 8.7, 0.826, 8.3, 0.834, 0.593, 0.964),
        _quoted(_V3, "Hamba", 6.9, 0.861, 6.8, 0.864, 0.681, 0.982),
        _quoted(_V3, "HandOS", 6.8, None, 6.7, None, 0.688, 0.983),
        _ours(_V3, 5.8, 0.884, 6.3, 0.874, 0.715, 0.989),
    ),
    _NOTES,
)
