"""One self-contained HTML page per reconstruction: meshes, cameras with their images, and a frame slider.

The page is viser's client with the recorded scene in it: it opens from disk with no network. A take becomes
a recording in which every frame lasts `SECONDS_PER_FRAME`; viser's playback bar is the slider. viser is
imported only here, and late, since it takes a while.
"""

import contextlib
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.geometry.cameras import project
from poem_jax.geometry.transforms import unit_vectors
from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float, Int, UInt8

SECONDS_PER_FRAME = 0.5
HAND_RGB = {"right": (255, 120, 40), "left": (50, 130, 255)}

_FIELD_OF_VIEW = np.deg2rad(55.0)
_FRUSTUM_DEPTH_SHARE = 0.3
_CANDIDATE_VIEWS = 24
_CLEAR_ANGLE = np.deg2rad(30.0)
_BLANK = np.zeros((2, 2, 3), np.uint8)
"""Shown by a camera that has no picture in a frame, in place of that of the frame before."""


class PageCamera(NamedTuple):
    """An ideal pinhole camera with its principal point in the middle of its picture."""

    name: str
    T_cam_from_world: Float[Array, "4 4"]
    focal_px: float
    """Focal length in pixels of the pictures shown."""
    hw: tuple[int, int]
    """Size of the pictures shown."""


class PageFrame(NamedTuple):
    """What one frame of a take shows."""

    name: str
    hands: Mapping[str, Float[Array, "vert 3"]]
    """Vertices in world metres by a unique hand name that starts with its side; absent hands are left out."""
    images: Sequence[UInt8[Array, "h w 3"] | None]
    """One RGB picture per camera (sizes as in its `PageCamera`), None where there is none."""


class View(NamedTuple):
    """Where the page's own camera stands when it opens, in world metres."""

    position: Float[Array, "3"]
    look_at: Float[Array, "3"]
    up: Float[Array, "3"]
    fov: float
    """Vertical field of view, radians."""


def initial_view(points_world: Float[Array, "point 3"], T_cam_from_world: Float[Array, "view 4 4"]) -> View:
    """Choose the page's first view: the points fill a third of it, with as many cameras around as can be.

    "Up" is the mean of the cameras' own up. Directions all around it, slightly from above, are tried: the one
    that shows most cameras is taken, among those from where no camera's picture floats before the hand.
    """
    centre = (points_world.min(0) + points_world.max(0)) / 2
    radius = np.linalg.norm(points_world - centre, axis=-1).max()
    R_world_from_cam = np.swapaxes(T_cam_from_world[:, :3, :3], -1, -2)
    positions = -np.einsum("vij,vj->vi", R_world_from_cam, T_cam_from_world[:, :3, 3])
    up = -R_world_from_cam[:, :, 1].mean(0)
    if np.linalg.norm(up) < 0.1:
        up = -R_world_from_cam[0, :, 1]
    up = unit_vectors(up)
    distance = 3.0 * radius / np.tan(_FIELD_OF_VIEW / 2)
    views = [
        View(centre + distance * direction, centre, up, float(_FIELD_OF_VIEW))
        for direction in _directions(up)
    ]
    return max(views, key=lambda view: _merit(view, positions))


def _directions(up: Float[Array, "3"]) -> Float[Array, "candidate 3"]:
    """Directions around `up`, a little above its equator."""
    ahead = unit_vectors(np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.8 else [0, 1.0, 0]))
    turns = np.linspace(0, 2 * np.pi, _CANDIDATE_VIEWS, endpoint=False)[:, None]
    return unit_vectors(np.cos(turns) * ahead + np.sin(turns) * np.cross(up, ahead) + 0.35 * up)


def _merit(view: View, positions: Float[Array, "view 3"]) -> float:
    """Count the cameras in sight; less than nothing if one stands between the eye and the hand."""
    K, T_eye_from_world = view_camera(view, (3, 4))
    uv, depth = project(K, T_eye_from_world, positions)
    in_sight = (depth > 0) & (uv > 0).all(-1) & (uv < [4, 3]).all(-1)
    to_cameras, to_eye = unit_vectors(positions - view.look_at), unit_vectors(view.position - view.look_at)
    nearest = float((to_cameras @ to_eye).max())
    hidden = nearest > np.cos(_CLEAR_ANGLE)
    return float(in_sight.sum()) - nearest / 10 - (len(positions) + 1) * hidden


def view_camera(view: View, hw: tuple[int, int]) -> tuple[Float[Array, "3 3"], Float[Array, "4 4"]]:
    """Return `K` and `T_cam_from_world` (OpenCV axes) of a page's view in a window of size `hw`."""
    height, width = hw
    focal = height / 2 / np.tan(view.fov / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    z = unit_vectors(view.look_at - view.position)
    x = unit_vectors(np.cross(z, view.up))
    R_cam_from_world = np.stack([x, np.cross(z, x), z])
    T_cam_from_world = np.eye(4)
    T_cam_from_world[:3, :3] = R_cam_from_world
    T_cam_from_world[:3, 3] = -R_cam_from_world @ view.position
    return K, T_cam_from_world


def write_page(
    path: str | os.PathLike,
    frames: Sequence[PageFrame],
    cameras: Sequence[PageCamera],
    faces: Mapping[str, Int[Array, "face 3"]],
    *,
    view: View | None = None,
) -> Path:
    """Write the page; the file appears whole or not at all.

    Args:
        path: The HTML file.
        frames: The take in order, at least one.
        cameras: The cameras of every frame's `images`.
        faces: Triangles by side, 'right' and 'left', counter-clockwise seen from outside.
        view: First view; None = `initial_view` of the first frame with a hand.

    Raises:
        ValueError: No frame, or no hand in any frame and no `view`.
    """
    if not frames:
        raise ValueError("a page needs at least one frame; got none")
    if view is None:
        view = initial_view(_first_points(frames), np.stack([camera.T_cam_from_world for camera in cameras]))
    with _silent_server() as server:
        html = _record(server, frames, cameras, faces, view)
    with whole_file(path) as temporary:
        temporary.write_text(html, encoding="utf-8")
    return Path(path)


def _record(server: Any, frames: Sequence[PageFrame], cameras, faces, view: View) -> str:
    _set_stage(server, view)
    shown = _add_cameras(server, cameras, frames[0], view)
    hands: dict[str, Any] = {}
    _show_hands(server, hands, frames[0], faces)
    serializer = server.get_scene_serializer()
    several = len(frames) > 1
    for index, frame in enumerate(frames):
        if index:
            _show_images(shown, frame)
            _show_hands(server, hands, frame, faces)
        if several:
            _show_name(server, frame, view)
            serializer.insert_sleep(SECONDS_PER_FRAME)
    return serializer.as_html()


def _set_stage(server: Any, view: View) -> None:
    server.scene.set_up_direction(view.up)
    # The default environment map comes over the network; plain lights do not.
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(True, cast_shadow=False)
    server.scene.add_light_ambient("/ambient", intensity=1.0)
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up, camera.fov = view.position, view.look_at, view.up, view.fov


def _add_cameras(server: Any, cameras: Sequence[PageCamera], first: PageFrame, view: View) -> list[Any]:
    import viser.transforms

    shown = []
    for camera, image in zip(cameras, first.images, strict=True):
        R_world_from_cam = camera.T_cam_from_world[:3, :3].T
        position = -R_world_from_cam @ camera.T_cam_from_world[:3, 3]
        fov, aspect = 2 * np.arctan(camera.hw[0] / 2 / camera.focal_px), camera.hw[1] / camera.hw[0]
        handle = server.scene.add_camera_frustum(
            f"/cameras/{camera.name}",
            fov=float(fov),
            aspect=float(aspect),
            scale=_frustum_scale(fov, aspect, float(np.linalg.norm(position - view.look_at))),
            thickness=0.0015,
            image=image,
            jpeg_quality=80,
            wxyz=viser.transforms.SO3.from_matrix(R_world_from_cam).wxyz,
            position=position,
        )
        shown.append(handle)
    return shown


def _frustum_scale(fov: float, aspect: float, distance: float) -> float:
    """Undo viser's constant-volume scaling: the picture floats at a fixed share of the way to the hand."""
    half = np.tan(fov / 2)
    return float(_FRUSTUM_DEPTH_SHARE * distance * np.cbrt(half * half * aspect / 3.0))


def _show_images(shown: Sequence[Any], frame: PageFrame) -> None:
    for handle, image in zip(shown, frame.images, strict=True):
        handle.image = _BLANK if image is None else image


def _show_hands(server: Any, hands: dict[str, Any], frame: PageFrame, faces: Mapping[str, Array]) -> None:
    for name, vertices in frame.hands.items():
        if name in hands:
            hands[name].vertices = np.asarray(vertices, np.float32)
        else:
            side = "left" if name.startswith("left") else "right"
            hands[name] = server.scene.add_mesh_simple(
                f"/hands/{name}",
                np.asarray(vertices, np.float32),
                np.asarray(faces[side], np.uint32),
                color=HAND_RGB[side],
                side="double",
            )
    for name, handle in hands.items():
        handle.visible = name in frame.hands


def _show_name(server: Any, frame: PageFrame, view: View) -> None:
    half_height = np.linalg.norm(view.position - view.look_at) * np.tan(view.fov / 2)
    below = view.look_at - 0.45 * half_height * view.up
    server.scene.add_label("/frame", f"frame {frame.name}", position=below)


@contextlib.contextmanager
def _silent_server() -> Iterator[Any]:
    """A viser server on this machine only, on any free port: the recorder of its scene hangs on it."""
    import viser

    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            yield server
        finally:
            server.stop()


def _first_points(frames: Sequence[PageFrame]) -> Array:
    for frame in frames:
        if frame.hands:
            return np.concatenate([np.asarray(vertices) for vertices in frame.hands.values()])
    raise ValueError("no frame holds a hand: pass `view` to say where the page should look")
