"""A panel: what the model finds in a few samples, drawn over all their views. NumPy only."""

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.geometry.cameras import project
from poem_jax.typing import Array, Bool, Float, Int, UInt8
from poem_jax.viz.overlay import MeshInView, draw_overlay, silhouette

_FOUND_RGB = (255, 170, 60)
_TRUE_RGB = (255, 255, 255)
_OPACITY = 0.55


def draw_panel(
    batch: MultiViewBatch,
    vertices_world: Float[Array, "batch 778 3"],
    solved: Bool[Array, " batch"],
    faces: Int[Array, "face 3"],
) -> UInt8[Array, "h w 3"]:
    """Draw a row for every sample and a column for every view.

    Args:
        batch: the samples, NumPy; padded samples and views stay black.
        vertices_world: what was found, metres, in the batch's world.
        solved: a sample that is not shows its images alone.
        faces: triangles of the hand model.

    Returns:
        The panel, RGB: the mesh that was found in orange, the outline of the true one in white.
    """
    shows = batch.cameras.view_mask
    if batch.sample_mask is not None:
        shows = shows & batch.sample_mask[:, None]
    rows, columns = np.flatnonzero(shows.any(1)), int(shows.any(0).nonzero()[0].max(initial=0)) + 1
    h, w = batch.views.shape[-3:-1]
    panel = np.zeros((max(len(rows), 1) * h, columns * w, 3), np.uint8)
    for place, row in enumerate(rows):
        for view in np.flatnonzero(shows[row]):
            camera = batch.cameras.K[row, view], batch.cameras.T_cam_from_world[row, view]
            found = [_in_view(vertices_world[row], *camera, faces, _FOUND_RGB)] if solved[row] else []
            tile = draw_overlay(_pixels(batch.views[row, view]), found, opacity=_OPACITY)
            true = silhouette([_in_view(batch.vertices_world[row], *camera, faces, _TRUE_RGB)], (h, w))
            tile[_edge(true)] = _TRUE_RGB
            panel[place * h : (place + 1) * h, view * w : (view + 1) * w] = tile
    return panel


def _in_view(
    vertices_world: Array, K: Array, T_cam_from_world: Array, faces: Array, rgb: tuple[int, int, int]
) -> MeshInView:
    uv_px, _ = project(K, T_cam_from_world, vertices_world)
    R, t = T_cam_from_world[:3, :3], T_cam_from_world[:3, 3]
    return MeshInView(uv_px, vertices_world @ R.T + t, faces, rgb)


def _pixels(view: Array) -> UInt8[Array, "h w 3"]:
    if view.dtype == np.uint8:
        return view
    return np.clip(np.rint(255.0 * view), 0, 255).astype(np.uint8)


def _edge(covered: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """Covered pixels beside free ones."""
    inside = np.zeros_like(covered)
    inside[1:-1, 1:-1] = covered[:-2, 1:-1] & covered[2:, 1:-1] & covered[1:-1, :-2] & covered[1:-1, 2:]
    return covered & ~inside
