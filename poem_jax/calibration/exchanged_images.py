"""Images exchanged between cameras, mirrored or turned: each possibility, and how well it would fit."""

from collections.abc import Callable, Iterator
from itertools import combinations, permutations

import numpy as np

from poem_jax.calibration.epipolar import (
    epipolar_distances_px,
    fundamental_matrix,
    ideal_keypoints,
    median_distance,
)
from poem_jax.calibration.findings import Finding
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Float

MAX_ORDERED_VIEWS = 5
"""Of so many cameras every order is tried; of more, every exchange of two."""
_Flip = Callable[[Array, Array], Array]
_FLIPS: dict[str, _Flip] = {
    "mirrored left to right": lambda uv, wh: np.stack([wh[0] - uv[..., 0], uv[..., 1]], -1),
    "turned by 180 degrees": lambda uv, wh: wh - uv,
    "mirrored top to bottom": lambda uv, wh: np.stack([uv[..., 0], wh[1] - uv[..., 1]], -1),
}


def exchanged_or_flipped(
    rig: Rig, keypoints_px: Float[Array, "frame hand view joint 2"]
) -> Iterator[tuple[float, Finding]]:
    """Yield what may be wrong, with the largest median distance of a pair of cameras once it is undone."""
    table = _distances_by_camera(rig, keypoints_px)
    for order in _orders(rig.num_views):
        cost = worst_px([table[i, j][order[i], order[j]] for i, j in combinations(range(rig.num_views), 2)])
        yield cost, _exchanged(rig, order)
    for view, name in enumerate(rig.names):
        for flip, turn in _FLIPS.items():
            undone = keypoints_px.copy()
            undone[:, :, view] = turn(undone[:, :, view], rig.size_wh[view])
            evidence = f"the image of camera '{name}' seems to be {flip}: only so it fits the others"
            finding = Finding("flipped image", evidence, "store it as the camera was calibrated")
            yield worst_px(epipolar_distances_px(rig, ideal_keypoints(rig, undone))), finding


def _distances_by_camera(rig: Rig, keypoints_px: Array) -> dict[tuple[int, int], Float[Array, "view view"]]:
    """Return, for cameras i and j, the distances were they to have taken the images of views a and b."""
    views = range(rig.num_views)
    ideal = []
    for camera in views:
        lens = rig._replace(K=rig.K[[camera] * rig.num_views], dist=rig.dist[[camera] * rig.num_views])
        points = np.moveaxis(ideal_keypoints(lens, keypoints_px), 2, 0)
        ideal.append(points.reshape(rig.num_views, -1, 2))
    table = {}
    for i, j in combinations(views, 2):
        F = fundamental_matrix(rig, i, j)
        table[i, j] = np.array(
            [
                [np.nan if a == b else median_distance(F, ideal[i][a], ideal[j][b]) for b in views]
                for a in views
            ]
        )
    return table


def _orders(num_views: int) -> Iterator[tuple[int, ...]]:
    """Yield which view's key points a camera may have got, other than its own."""
    given = tuple(range(num_views))
    if num_views <= MAX_ORDERED_VIEWS:
        yield from (order for order in permutations(given) if order != given)
        return
    yield given[::-1]
    for a, b in combinations(given, 2):
        order = list(given)
        order[a], order[b] = b, a
        yield tuple(order)


def _exchanged(rig: Rig, order: tuple[int, ...]) -> Finding:
    moved = [
        f"'{rig.names[view]}' is of '{rig.names[camera]}'"
        for camera, view in enumerate(order)
        if camera != view
    ]
    return Finding(
        "cameras exchanged",
        f"the cameras seem to be exchanged: what is given as {', '.join(moved)}; only so the views fit",
        "rename the images or the cameras of the rig, or give the views in the rig's order of cameras "
        "(`cameras (V,)` in the file of key points or boxes names them)",
    )


def worst_px(distances: Float[Array, "*pair"] | list[float]) -> float:
    """Return the largest distance; infinity where no pair of cameras can be judged."""
    finite = np.asarray(distances)[np.isfinite(distances)]
    return float(finite.max()) if finite.size else np.inf
