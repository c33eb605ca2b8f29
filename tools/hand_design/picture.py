"""The picture of the docs: the hand at rest from six sides, in the families of poses, and in other shapes."""

from pathlib import Path

import cv2
import numpy as np

from poem_jax.geometry.transforms import rotation_from_axis_angle
from poem_jax.hand import HandModel, hand_mesh
from poem_jax.hand.template import SHAPE_NAMES
from poem_jax.render.zbuffer import NO_FACE, rasterise
from poem_jax.synthetic.poses import FAMILIES, angles_to_pose, sample_angles

_TILE = 230
_SUPERSAMPLE = 2
_PIXELS_PER_M = 1050.0
_SKIN_BGR = np.array([150.0, 175.0, 225.0])
_LIGHTS = (((-0.4, -0.6, -0.7), 0.65), ((0.8, 0.1, -0.5), 0.25))
_AMBIENT = 0.25

# Rows: the image's right, its down, and forward, in the hand's frame.
_BACK = np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]])
_PALM = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
VIEWS = {
    "back": _BACK,
    "palm": _PALM,
    "thumb side": np.array([[-1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
    "little side": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1]]),
    "finger tips": np.array([[0, 0, 1.0], [0, -1, 0], [1, 0, 0]]),
    "oblique": rotation_from_axis_angle(np.array([-0.8, 0.3, 0.0])) @ _PALM,
}


def render(vertices: np.ndarray, faces: np.ndarray, axes: np.ndarray, caption: str = "") -> np.ndarray:
    """Draw one tile, (h, w, 3) BGR uint8: orthographic, smooth shading; inner faces are dark red."""
    size = _TILE * _SUPERSAMPLE
    center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    turned = (vertices - center) @ axes.T
    uv = turned[:, :2] * _PIXELS_PER_M * _SUPERSAMPLE + size / 2
    raster = rasterise(np.column_stack([uv, turned[:, 2] + 1.0]), faces, (size, size))
    seen = raster.face_index != NO_FACE
    corners = faces[raster.face_index[seen]]
    normals, flat = _vertex_normals(vertices, faces)
    normal = np.einsum("pk,pkc->pc", raster.barycentric[seen], normals[corners])
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)) @ axes.T
    image = np.full((size, size, 3), 255.0)
    image[seen] = _SKIN_BGR * _shade(normal)[:, None]
    inner = flat[raster.face_index[seen]] @ axes[2] > 0
    image[seen] = np.where(inner[:, None], (40, 40, 110), image[seen])
    tile = cv2.resize(np.clip(image, 0, 255).astype(np.uint8), (_TILE, _TILE), interpolation=cv2.INTER_AREA)
    return cv2.putText(tile, caption, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60, 60, 60), 1, cv2.LINE_AA)


def _vertex_normals(v: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (v[faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    normals = np.zeros_like(v)
    for k in range(3):
        np.add.at(normals, faces[:, k], flat)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True), flat


def _shade(normal: np.ndarray) -> np.ndarray:
    shade = np.full(len(normal), _AMBIENT)
    for direction, strength in _LIGHTS:
        shade += strength * np.clip(normal @ (np.array(direction) / np.linalg.norm(direction)), 0, 1)
    return shade


def contact_sheet(hand: HandModel) -> np.ndarray:
    """Rows: rest from six sides; two rows of poses; the first six shape directions at -2 and +2."""
    rows = [[render(hand.v_template.astype(float), hand.faces, axes, name) for name, axes in VIEWS.items()]]
    rng = np.random.default_rng(2)
    for view in ("palm", "oblique"):
        tiles = []
        for family in FAMILIES:
            pose = angles_to_pose(sample_angles(rng, 1, family))
            mesh = hand_mesh(hand, pose[0], np.zeros(10))
            tiles.append(render(mesh.vertices, hand.faces, VIEWS[view], family))
        rows.append(tiles)
    for sign in (-2.0, 2.0):
        shapes = sign * np.eye(10)[:6]
        meshes = hand_mesh(hand, np.zeros((6, 16, 3)), shapes).vertices
        names = [f"{name} {sign:+.0f}" for name in SHAPE_NAMES[:6]]
        rows.append([render(v, hand.faces, _PALM, n) for v, n in zip(meshes, names, strict=True)])
    return _stacked(rows)


def _stacked(rows: list[list[np.ndarray]]) -> np.ndarray:
    """Lay tiles (h, w, 3) in rows; shorter rows end in white."""
    width, blank = max(len(row) for row in rows), np.full_like(rows[0][0], 255)
    padded = [row + [blank] * (width - len(row)) for row in rows]
    return np.concatenate([np.concatenate(row, axis=1) for row in padded])


def save(path: Path, image: np.ndarray) -> None:
    """Write a JPEG of moderate size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 82]):
        raise OSError(f"could not write {path}")
