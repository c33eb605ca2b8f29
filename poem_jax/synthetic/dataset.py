"""Endless multi-view captures with exact ground truth, a pure function of (seed, index).

NumPy and numba only: data workers never import JAX. Chance comes from three streams per sample (scene,
cameras, sensors), so a sample is the same bit for bit in any order, process or thread, and its first n
views are the same whatever number of views is asked for.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.geometry.cameras import Cameras, project
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import NUM_FACES, NUM_JOINTS, NUM_VERTICES
from poem_jax.render.zbuffer import draw_faces, empty_buffers
from poem_jax.synthetic.backgrounds import SIZE, make_backgrounds
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.scene import (
    Body,
    Light,
    Mesh,
    build_mesh,
    cast_shadows,
    draw_body,
    draw_light,
    prepare_hand,
)
from poem_jax.synthetic.sensor import Exposure, develop_picture, draw_exposures, warp_background
from poem_jax.synthetic.shading import (
    count_samples,
    cover,
    project_points,
    shade_over,
    vertices_seen,
)
from poem_jax.synthetic.viewpoints import Viewpoints, draw_viewpoints
from poem_jax.typing import Array, Bool, Float, UInt8

NEAR_M = 0.02
"""Faces nearer to a camera than this are not drawn."""
_SURFACE_TOLERANCE_M = 0.004
_JOINT_TOLERANCE_M = 0.025
_SCENE, _CAMERAS, _SENSORS = range(3)


class SyntheticSample(NamedTuple):
    """A sample and what only a simulator knows about it. No batch axis."""

    batch: MultiViewBatch
    hand_coverage: Float[Array, "view h w"]
    """Share of each pixel that shows the hand (without the forearm), in [0, 1]."""
    hidden_share: Float[Array, " view"]
    """Share of the hand's silhouette that objects or the end of the full frame hide, together with the
    share of its vertices beyond the crop; what the hand or the forearm hide themselves does not count."""
    vertex_visible: Bool[Array, "view 778"]
    """Inside crop and frame, with nothing more than 4 mm before it."""
    joint_visible: Bool[Array, "view 21"]
    """Inside crop and frame, with nothing more than 25 mm before it (joints lie under the skin)."""
    box_px: Float[Array, "view 4"]
    """Where the crop lies in the full frame."""


class _View(NamedTuple):
    """One rendered view."""

    image: UInt8[Array, "h w 3"]
    hand_coverage: Float[Array, "h w"]
    hidden_share: float
    vertex_visible: Bool[Array, "778"]
    joint_visible: Bool[Array, "21"]


class Scene(NamedTuple):
    """Everything of a sample but its pictures."""

    body: Body
    mesh: Mesh
    attributes: Float[Array, "vert c"]
    """Of the mesh's vertices, as the shading kernel reads them."""
    light: Light
    viewpoints: Viewpoints
    exposures: list[Exposure]


class SyntheticDataset:
    """Random access to the samples of one distribution and one seed."""

    def __init__(self, config: SyntheticConfig, seed: int, hand: HandModel | None = None) -> None:
        """Prepare the hand (default: the shipped right one) and the backgrounds.

        Raises:
            ValueError: a negative seed.
        """
        if seed < 0:
            raise ValueError(f"`seed` must not be negative; got {seed}")
        if hand is None:
            from poem_jax.hand import default_hand

            hand = default_hand()
        self.config, self.seed = config, seed
        self.prepared = prepare_hand(hand)
        self.backgrounds = make_backgrounds(seed, config.num_backgrounds)

    def __getitem__(self, index: int) -> MultiViewBatch:
        """Return sample `index` with all its views, without batch axis."""
        return self.sample(index)

    def sample(self, index: int, num_views: int | None = None) -> MultiViewBatch:
        """Return the first `num_views` (None = all) views of sample `index`, without batch axis."""
        return self.render_sample(index, num_views).batch

    def render_sample(self, index: int, num_views: int | None = None) -> SyntheticSample:
        """Return a sample with masks and visibility; see `SyntheticSample`.

        Raises:
            ValueError: a negative index, or more views than the distribution has.
        """
        views = self._check(index, num_views)
        scene = self.draw_scene(index)
        rendered = [self._render(scene, view) for view in range(views)]
        return _assemble(scene, rendered)

    def draw_scene(self, index: int) -> Scene:
        """Draw everything of a sample but its pictures."""
        config = self.config
        rng = self._stream(index, _SCENE)
        body = draw_body(self.prepared, config.body, rng)
        joints = body.joints_world.astype(np.float64)
        viewpoints = draw_viewpoints(
            config.cameras,
            config.crop,
            self._stream(index, _CAMERAS),
            joints,
            config.num_views,
            config.image_hw,
        )
        mesh = build_mesh(self.prepared, body, viewpoints.camera_world, config, rng)
        light = draw_light(config.light, rng)
        sensors = self._stream(index, _SENSORS)
        exposures = draw_exposures(config.sensor, sensors, config.num_views, len(self.backgrounds), SIZE)
        mesh = cast_shadows(mesh, light)
        return Scene(body, mesh, mesh.attributes(), light, viewpoints, exposures)

    def _stream(self, index: int, stream: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, index, stream))

    def _check(self, index: int, num_views: int | None) -> int:
        most = self.config.num_views
        views = most if num_views is None else num_views
        if index < 0 or not 1 <= views <= most:
            raise ValueError(
                f"`index` must not be negative and `num_views` be 1 to {most}; got {index} and {views}"
            )
        return int(views)

    def _render(self, scene: Scene, view: int) -> _View:
        at = scene.viewpoints
        return render_view(
            scene,
            K=at.K_crop[view],
            T_cam_from_world=at.T_cam_from_world[view],
            full_frame=at.frame_in_crop[view],
            exposure=scene.exposures[view],
            background=self.backgrounds[scene.exposures[view].background],
            hw=self.config.image_hw,
            scale=self.config.supersample,
        )


def render_view(
    scene: Scene,
    *,
    K: Float[Array, "3 3"],
    T_cam_from_world: Float[Array, "4 4"],
    full_frame: Float[Array, "4"],
    exposure: Exposure,
    background: UInt8[Array, "side side 3"],
    hw: tuple[int, int],
    scale: int,
) -> _View:
    """Draw one view of a scene: z-buffer, shading over a background, camera.

    Args:
        scene: what to draw.
        K: intrinsics of the image to draw, float32 values (any float type).
        T_cam_from_world: extrinsics.
        full_frame: the full frame's extent in the image's pixels; beyond it the image is black.
        exposure: the camera's settings.
        background: texture behind everything.
        hw: size of the image.
        scale: samples per pixel and axis.
    """
    K, T = _rounded(K), _rounded(T_cam_from_world)
    mesh = scene.mesh
    points = np.empty((len(mesh.vertices), 3))
    project_points(K, T, mesh.vertices, float(scale), points)
    face_index, inverse_depth = empty_buffers((hw[0] * scale, hw[1] * scale))
    body = int(np.searchsorted(mesh.face_material, 0, side="right"))
    draw_faces(points, mesh.faces[:body], 0, True, NEAR_M, face_index, inverse_depth)
    before = count_samples(face_index, NUM_FACES)
    draw_faces(points, mesh.faces[body:], body, True, NEAR_M, face_index, inverse_depth)
    coverage = np.empty(hw, np.float32)
    after = cover(face_index, NUM_FACES, scale, full_frame, coverage)

    image = np.empty((*hw, 3), np.float32)
    center = -T[:3, :3].T @ T[:3, 3]
    behind, tones = warp_background(background, exposure, hw)
    surface = (mesh.faces, mesh.face_material, scene.attributes, mesh.materials)
    lighting = (*scene.light, center.astype(np.float32))
    raster = (points, face_index, inverse_depth)
    shade_over(surface, lighting, raster, scale, full_frame, behind, tones, image)

    hand_px, joints_px = points[:NUM_VERTICES], np.empty((NUM_JOINTS, 3))
    project_points(K, T, scene.body.joints_world, float(scale), joints_px)
    seen, joint_seen = np.empty(NUM_VERTICES, bool), np.empty(NUM_JOINTS, bool)
    vertices_seen(hand_px, inverse_depth, scale, full_frame, _SURFACE_TOLERANCE_M, seen)
    vertices_seen(joints_px, inverse_depth, scale, full_frame, _JOINT_TOLERANCE_M, joint_seen)
    inside = ((hand_px[:, :2] >= 0) & (hand_px[:, :2] < np.array(hw[::-1]) * scale)).all(-1).mean()
    hidden = 1 - inside * (after / before if before else 0.0)
    return _View(develop_picture(image, exposure), coverage, float(hidden), seen, joint_seen)


def _rounded(matrix: Array) -> Array:
    """Round to float32, as the sample will hold it, so that picture and labels agree to the last bit."""
    return np.ascontiguousarray(matrix, np.float32).astype(np.float64)


def _assemble(scene: Scene, rendered: list[_View]) -> SyntheticSample:
    body, views = scene.body, len(rendered)
    K = scene.viewpoints.K_crop[:views].astype(np.float32)
    T = scene.viewpoints.T_cam_from_world[:views].astype(np.float32)
    joints = np.broadcast_to(body.joints_world.astype(np.float64), (views, NUM_JOINTS, 3))
    keypoints_px = project(K.astype(np.float64), T.astype(np.float64), joints)[0]
    batch = MultiViewBatch(
        views=np.stack([view.image for view in rendered]),
        cameras=Cameras(K, T),
        joints_world=body.joints_world,
        vertices_world=body.vertices_world,
        keypoints_px=keypoints_px.astype(np.float32),
        pose=body.pose,
        shape=body.shape,
    )
    return SyntheticSample(
        batch,
        np.stack([view.hand_coverage for view in rendered]),
        np.array([view.hidden_share for view in rendered], np.float32),
        np.stack([view.vertex_visible for view in rendered]),
        np.stack([view.joint_visible for view in rendered]),
        scene.viewpoints.box_px[:views],
    )
