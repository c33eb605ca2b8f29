"""Hands as they move, among the cameras with their pictures: a scene that viser serves to browsers."""

import time
from collections.abc import Mapping, Sequence

import numpy as np
import viser
from viser import transforms

from poem_jax.geometry.transforms import invert_rigid
from poem_jax.typing import Array, Float, Int, UInt8
from poem_jax.viz.first_view import View, initial_view
from poem_jax.viz.page_content import HAND_RGB, PageCamera

_PICTURES_S = 0.2
"""Pictures are renewed so often at most: they take most of the way to the browser."""
_JPEG_QUALITY = 70
_FRUSTUM_M = 0.12


class LiveScene:
    """The scene; whoever opens its address sees it."""

    def __init__(
        self,
        cameras: Sequence[PageCamera],
        faces: Mapping[str, Int[Array, "face 3"]],
        host: str,
        port: int,
    ) -> None:
        """Begin to serve it.

        Args:
            cameras: Where the pictures stand.
            faces: Triangles by side.
            host, port: Where to listen; the port must be free.
        """
        self._server = viser.ViserServer(host, port, label="poem live", verbose=False)
        self._cameras, self._faces = cameras, faces
        self._numbers = self._server.gui.add_markdown("waiting for the first moment")
        self._meshes: dict[str, viser.MeshHandle] = {}
        self._frusta = [self._frustum(camera) for camera in cameras]
        self._pictured_s = -np.inf
        self._looked = False
        up = -np.mean([camera.T_cam_from_world[1, :3] for camera in cameras], axis=0)
        self._server.scene.set_up_direction(up / max(float(np.linalg.norm(up)), 1e-9))

    @property
    def is_watched(self) -> bool:
        """Whether a browser looks at it."""
        return bool(self._server.get_clients())

    @property
    def wants_pictures(self) -> bool:
        """Whether it is time for new pictures, and anybody looks."""
        return self.is_watched and time.monotonic() - self._pictured_s >= _PICTURES_S

    def show_hands(self, vertices_world: Mapping[str, Float[Array, "vert 3"]]) -> None:
        """Show the hands of a moment, by side; those that are left out are hidden."""
        with self._server.atomic():
            for side, vertices in vertices_world.items():
                if side not in self._meshes:
                    self._meshes[side] = self._mesh(side, vertices)
                self._meshes[side].vertices = np.asarray(vertices, np.float32)
            for side, mesh in self._meshes.items():
                mesh.visible = side in vertices_world
        if vertices_world and not self._looked:
            self._looked = True
            self._look(np.concatenate([np.asarray(points) for points in vertices_world.values()]))

    def show_pictures(self, pictures: Sequence[UInt8[Array, "h w 3"] | None]) -> None:
        """Show the cameras' pictures, RGB, of the sizes of their cameras; None leaves the last."""
        self._pictured_s = time.monotonic()
        for frustum, picture in zip(self._frusta, pictures, strict=True):
            if picture is not None:
                frustum.image = picture

    def tell(self, text: str) -> None:
        """Show a text beside the scene (Markdown)."""
        self._numbers.content = text

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()

    def _frustum(self, camera: PageCamera) -> viser.CameraFrustumHandle:
        T_world_from_cam = invert_rigid(np.asarray(camera.T_cam_from_world, np.float64))
        height, width = camera.hw
        return self._server.scene.add_camera_frustum(
            f"/cameras/{camera.name}",
            fov=float(2 * np.arctan2(height / 2, camera.focal_px)),
            aspect=width / height,
            scale=_FRUSTUM_M,
            image=np.full((height, width, 3), 60, np.uint8),
            format="jpeg",
            jpeg_quality=_JPEG_QUALITY,
            wxyz=transforms.SO3.from_matrix(T_world_from_cam[:3, :3]).wxyz,
            position=T_world_from_cam[:3, 3],
        )

    def _mesh(self, side: str, vertices: Float[Array, "vert 3"]) -> viser.MeshHandle:
        faces = np.asarray(self._faces[side], np.uint32)
        return self._server.scene.add_mesh_simple(
            f"/hands/{side}", np.asarray(vertices, np.float32), faces, color=HAND_RGB[side]
        )

    def _look(self, points_world: Float[Array, "point 3"]) -> None:
        """Let all look at the hands from where they and the cameras are seen best."""
        view: View = initial_view(points_world, np.stack([c.T_cam_from_world for c in self._cameras]))
        first = self._server.initial_camera
        first.position, first.look_at, first.up = map(np.asarray, (view.position, view.look_at, view.up))
        for client in self._server.get_clients().values():
            camera = client.camera
            camera.position, camera.look_at, camera.up_direction = view.position, view.look_at, view.up
