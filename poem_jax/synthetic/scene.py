"""One scene: a posed hand with its forearm, objects, and lights, as arrays that the kernels read.

The scene lives in the sample's own world frame (metres); nothing here knows how many views will be drawn.
"""

from typing import NamedTuple

import numpy as np

from poem_jax.geometry.transforms import axis_angle_from_rotation, unit_vectors
from poem_jax.hand.model import HandModel, hand_mesh
from poem_jax.hand.topology import INDEX_KNUCKLE, LITTLE_KNUCKLE, NUM_SHAPES, NUM_VERTICES, ROOT_JOINT, WRIST
from poem_jax.render.zbuffer import draw_faces, empty_buffers
from poem_jax.synthetic.config import BodyConfig, LightConfig, OccluderConfig, Range, SyntheticConfig
from poem_jax.synthetic.poses import sample_pose
from poem_jax.synthetic.shading import NUM_MATERIAL, lit_share, vertex_normals
from poem_jax.synthetic.skin import SkinMap, map_skin, skin_colors
from poem_jax.synthetic.surfaces import (
    Solid,
    forearm_faces,
    grow_forearm,
    unit_box,
    unit_cylinder,
    unit_sphere,
    wrist_loop,
)
from poem_jax.synthetic.viewpoints import directions_on_sphere
from poem_jax.typing import Array, Float, Int

_SHADOW_CELLS = 96
_SHADOW_BIAS_M = 0.005
"""A surface must lie this far behind another to be in its shadow: more than the sag of a coarse face."""


_USUAL_POWER = 0.65
"""Light power at which exposure is left alone."""


class PreparedHand(NamedTuple):
    """What every scene of one hand shares."""

    hand: HandModel
    faces: Int[Array, "face 3"]
    loop: Int[Array, " edge"]
    arm_faces: Int[Array, "face 3"]
    skin: SkinMap


class Body(NamedTuple):
    """The hand's ground truth, in the world."""

    pose: Float[Array, "16 3"]
    shape: Float[Array, "10"]
    vertices_world: Float[Array, "778 3"]
    joints_world: Float[Array, "21 3"]


class Mesh(NamedTuple):
    """All surfaces of a scene; the hand's vertices and faces come first, then the forearm's, then
    objects'."""

    faces: Int[Array, "face 3"]
    face_material: Int[Array, " face"]
    vertices: Float[Array, "vert 3"]
    normals: Float[Array, "vert 3"]
    albedo: Float[Array, "vert 3"]
    local: Float[Array, "vert 3"]
    """Place in the object's own frame, where its pattern is read."""
    lit: Float[Array, " vert"]
    """Share of the first light that arrives."""
    materials: Float[Array, "material c"]

    def attributes(self) -> Float[Array, "vert c"]:
        """Return what is interpolated over faces, in the order that `shading` reads."""
        parts = [self.vertices, self.normals, self.albedo, self.local, self.lit[:, None]]
        return np.concatenate(parts, axis=1, dtype=np.float32)


class Light(NamedTuple):
    """Directional lights over a hemispheric ambient one, float32; colours are linear."""

    lights: Float[Array, "light 6"]
    """Unit vectors towards the lights, and their colours."""
    ambient: Float[Array, "3 3"]
    """Rows: the direction up, the colour from above, the colour from below."""


class Placed(NamedTuple):
    """A solid in the world with what paints it."""

    solid: Solid
    local: Float[Array, "vert 3"]
    color: Float[Array, "3"]
    material: Float[Array, " c"]


def prepare_hand(hand: HandModel) -> PreparedHand:
    """Find once what every scene of this hand needs: wrist loop, forearm faces, skin map."""
    faces = np.ascontiguousarray(hand.faces, dtype=np.int32)
    template = np.asarray(hand.v_template, np.float64)
    normals = np.empty_like(template)
    vertex_normals(template, faces, normals)
    loop = wrist_loop(faces)
    return PreparedHand(hand, faces, loop, forearm_faces(loop, NUM_VERTICES), map_skin(hand, normals))


def draw_body(prepared: PreparedHand, config: BodyConfig, rng: np.random.Generator) -> Body:
    """Draw pose, shape and place; ground truth is rounded to float32, and everything is built on that."""
    pose = np.array(sample_pose(rng, 1)[0], np.float32)
    pose[WRIST] = axis_angle_from_rotation(random_rotation(rng))
    shape = (config.shape_sigma * rng.standard_normal(NUM_SHAPES)).astype(np.float32)
    place = rng.uniform(*config.world_offset_m, 3).astype(np.float32)
    mesh = hand_mesh(prepared.hand, pose, shape, translation=place, center_joint=ROOT_JOINT)
    return Body(pose, shape, np.asarray(mesh.vertices, np.float32), np.asarray(mesh.joints, np.float32))


def build_mesh(
    prepared: PreparedHand,
    body: Body,
    cameras_world: Float[Array, "view 3"],
    config: SyntheticConfig,
    rng: np.random.Generator,
) -> Mesh:
    """Put forearm, skin and occluding objects around a hand; shadows are not yet cast."""
    vertices, normals, albedo, faces = _flesh(prepared, body, config.body, rng)
    side = -1.0 if bool(prepared.hand.is_left) else 1.0
    objects = _draw_objects(body, side, cameras_world, config.occluders, rng)
    first = np.cumsum([len(vertices), *(len(o.solid.vertices) for o in objects)])
    every = [o.solid for o in objects]
    all_vertices = np.concatenate([vertices, *(s.vertices for s in every)])
    counts = [len(faces), *(len(s.faces) for s in every)]
    return Mesh(
        faces=np.concatenate([faces, *(s.faces + n for s, n in zip(every, first, strict=False))]).astype(
            np.int32
        ),
        face_material=np.repeat(np.arange(len(counts), dtype=np.int32), counts),
        vertices=all_vertices,
        normals=np.concatenate([normals, *(s.normals for s in every)]),
        albedo=np.concatenate([albedo, *(np.tile(o.color, (len(o.local), 1)) for o in objects)]),
        local=np.concatenate([np.zeros_like(vertices), *(o.local for o in objects)]),
        lit=np.ones(len(all_vertices)),
        materials=np.stack([_skin_material(rng), *(o.material for o in objects)], dtype=np.float32),
    )


def draw_light(config: LightConfig, rng: np.random.Generator) -> Light:
    """Draw lights; an automatic exposure, one for all views, makes up for part of their power."""
    count = int(rng.integers(config.num_lights[0], config.num_lights[1] + 1))
    directions = directions_on_sphere(*rng.random((2, count + 1)))
    tint = 1 + config.tint * rng.uniform(-1, 1, (count + 2, 3))
    colors = rng.uniform(*config.intensity, (count, 1)) * tint[:count] / np.sqrt(count)
    ambient = rng.uniform(*config.ambient, (2, 1)) * tint[count:]
    power = ambient.mean() + 0.45 * colors.sum(0).mean()
    exposure = (_USUAL_POWER / power) ** 0.6
    lights = np.concatenate([directions[:count], colors * exposure], axis=1, dtype=np.float32)
    return Light(lights, np.concatenate([directions[count:], ambient * exposure], dtype=np.float32))


def cast_shadows(mesh: Mesh, light: Light) -> Mesh:
    """Set `lit` from a shadow map of the first light, smoothed over neighbouring cells."""
    toward = light.lights[0, :3].astype(np.float64)
    aside = np.cross(toward, np.eye(3)[np.argmin(np.abs(toward))])
    aside /= np.linalg.norm(aside)
    seen = mesh.vertices @ np.stack([aside, np.cross(toward, aside), -toward], axis=-1)
    low, high = seen.min(0), seen.max(0)
    # The light is far off, so 1/z is affine over a face as the rasteriser takes it to be; 10 m make it so.
    seen = (seen - low) * ([*(_SHADOW_CELLS / (high - low)[:2]), 1.0]) + [0, 0, 10.0]
    face_index, inverse_depth = empty_buffers((_SHADOW_CELLS, _SHADOW_CELLS))
    draw_faces(seen, mesh.faces, 0, False, 1.0, face_index, inverse_depth)
    lit = np.empty(len(seen))
    lit_share(seen, inverse_depth, _SHADOW_BIAS_M, lit)
    return mesh._replace(lit=lit)


def random_rotation(rng: np.random.Generator) -> Float[Array, "3 3"]:
    """Draw a rotation uniformly (a random unit quaternion; Shoemake 1992)."""
    w, x, y, z = q = rng.standard_normal(4)
    s = 2 / (q @ q)
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
        ]
    )


def _flesh(
    prepared: PreparedHand, body: Body, config: BodyConfig, rng: np.random.Generator
) -> tuple[Array, Array, Array, Array]:
    """Return vertices, normals, colours and faces of hand and forearm."""
    hand = body.vertices_world.astype(np.float64)
    arm = grow_forearm(
        hand[prepared.loop],
        body.joints_world[ROOT_JOINT].astype(np.float64),
        prepared.arm_faces,
        length=rng.uniform(*config.forearm_length_m),
        bend=np.radians(rng.uniform(*config.forearm_bend_deg)) * directions_on_sphere(*rng.random(2)),
        taper=rng.uniform(*config.forearm_taper),
        sleeve=bool(rng.random() < config.sleeve_probability),
    )
    vertices = np.concatenate([hand, arm.vertices])
    faces = np.concatenate([prepared.faces, arm.faces])
    normals = np.empty_like(vertices)
    vertex_normals(vertices, faces, normals)
    ring = np.resize(prepared.skin.rest[prepared.loop], arm.offsets.shape)
    albedo = skin_colors(prepared.skin, np.concatenate([prepared.skin.rest, ring + arm.offsets]), rng)
    albedo[NUM_VERTICES:] += arm.sleeve[:, None] * (rng.uniform(0, 1, 3) ** 1.8 - albedo[NUM_VERTICES:])
    return vertices, normals, albedo, faces


def _draw_objects(
    body: Body,
    side: float,
    cameras_world: Float[Array, "view 3"],
    config: OccluderConfig,
    rng: np.random.Generator,
) -> list[Placed]:
    joints = body.joints_world.astype(np.float64)
    center = joints.mean(0)
    chance = rng.random(len(cameras_world) + 2)
    objects = []
    if chance[0] < config.held_probability:
        objects.append(_held(joints, side, config, rng))
    if chance[1] < config.stray_probability:
        place = center + rng.uniform(0.1, 0.22) * directions_on_sphere(*rng.random(2))
        objects.append(_draw_object(place, random_rotation(rng), config.half_size_m, rng))
    for camera, draw in zip(cameras_world, chance[2:], strict=True):
        if draw < config.blocker_probability:
            toward = (camera - center) / np.linalg.norm(camera - center)
            place = center + toward * rng.uniform(*config.blocker_gap_m)
            place += config.blocker_offset_sigma_m * rng.standard_normal(3)
            objects.append(_draw_object(place, random_rotation(rng), config.half_size_m, rng))
    return objects


def _held(
    joints: Float[Array, "21 3"], side: float, config: OccluderConfig, rng: np.random.Generator
) -> Placed:
    """Put an object before the palm, its long axis across the fingers; `side` is -1 for a left hand."""
    across = joints[INDEX_KNUCKLE] - joints[LITTLE_KNUCKLE]
    across /= np.linalg.norm(across)
    forward = joints[ROOT_JOINT] - joints[WRIST]
    out_of_palm = side * np.cross(across, forward)
    out_of_palm /= np.linalg.norm(out_of_palm)
    turn = np.stack([np.cross(out_of_palm, across), out_of_palm, across], axis=-1)
    place = joints[WRIST] + 0.9 * forward + out_of_palm * rng.uniform(0.03, 0.06)
    return _draw_object(place, turn, config.held_half_size_m, rng, stretch=rng.uniform(1, 3))


def _draw_object(
    place: Float[Array, "3"],
    R_world_from_object: Float[Array, "3 3"],
    half_size_m: Range,
    rng: np.random.Generator,
    stretch: float = 1.0,
) -> Placed:
    """Draw a box, cylinder or ellipsoid with a painted surface; `stretch` lengthens its z axis."""
    solid = (unit_box, unit_cylinder, unit_sphere)[rng.integers(3)]()
    half = rng.uniform(*half_size_m, 3)
    if rng.random() < 0.5:
        half[1] = half[0]
    half[2] *= stretch
    local = solid.vertices * half
    normals = solid.normals / half
    normals = unit_vectors(normals)
    R = R_world_from_object.T
    color, material = _paint(rng)
    return Placed(Solid(local @ R + place, normals @ R, solid.faces), local, color, material)


def _paint(rng: np.random.Generator) -> tuple[Float[Array, "3"], Float[Array, " c"]]:
    """Draw two colours and the pattern that mixes them; see `shading` for the layout of a material."""
    first, second = rng.uniform(0, 1, (2, 3)) ** 2
    material = np.zeros(NUM_MATERIAL)
    material[:3] = second
    material[3:9] = rng.normal(size=6) * rng.uniform(20, 250)
    material[9] = rng.uniform(0, 0.6)
    material[10] = rng.random() < 0.35
    return first, material


def _skin_material(rng: np.random.Generator) -> Float[Array, " c"]:
    material = np.zeros(NUM_MATERIAL)
    material[9] = rng.uniform(0.0, 0.25)
    return material
