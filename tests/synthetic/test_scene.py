import numpy as np
import pytest

from poem_jax.hand import default_hand
from poem_jax.hand.topology import NUM_FACES, NUM_VERTICES
from poem_jax.synthetic.config import LightConfig, OccluderConfig, SyntheticConfig
from poem_jax.synthetic.scene import (
    build_mesh,
    cast_shadows,
    draw_body,
    draw_light,
    prepare_hand,
    random_rotation,
)
from poem_jax.synthetic.shading import NUM_ATTRIBUTES

CAMERAS = np.array([[0.0, 0, 1], [1, 0, 0]])
ALL = OccluderConfig(held_probability=1.0, blocker_probability=1.0, stray_probability=1.0)


@pytest.fixture(scope="module", params=["right", "left"])
def prepared(request):
    return prepare_hand(default_hand(request.param))


@pytest.fixture(scope="module")
def scene(prepared):
    rng = np.random.default_rng(0)
    config = SyntheticConfig(occluders=ALL)
    body = draw_body(prepared, config.body, rng)
    return body, build_mesh(prepared, body, body.joints_world.mean(0) + CAMERAS, config, rng)


def test_the_hand_comes_first_and_all_objects_are_there(prepared, scene):
    body, mesh = scene
    np.testing.assert_array_equal(mesh.vertices[:NUM_VERTICES], body.vertices_world)
    np.testing.assert_array_equal(mesh.faces[:NUM_FACES], prepared.faces)
    assert len(mesh.materials) == 1 + len(CAMERAS) + 2
    assert set(mesh.face_material) == set(range(len(mesh.materials)))
    assert (np.diff(mesh.face_material) >= 0).all()
    assert mesh.faces.max() == len(mesh.vertices) - 1
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-9)
    assert mesh.attributes().shape == (len(mesh.vertices), NUM_ATTRIBUTES)


def test_held_things_lie_before_the_palm(prepared):
    """The held object is the first; on either hand it is nearer to the palm's side than to the back."""
    rng = np.random.default_rng(1)
    config = SyntheticConfig(occluders=ALL)
    for _ in range(5):
        body = draw_body(prepared, config.body, rng)
        mesh = build_mesh(prepared, body, body.joints_world.mean(0) + CAMERAS, config, rng)
        held = mesh.vertices[np.unique(mesh.faces[mesh.face_material == 1])].mean(0)
        joints = body.joints_world.astype(float)
        back = np.cross(joints[9] - joints[0], joints[5] - joints[17])
        if prepared.hand.side == "left":
            back = -back
        assert (held - joints[[0, 5, 9, 17]].mean(0)) @ back < 0


def test_shadows_fall_on_what_the_light_does_not_reach(scene):
    _, mesh = scene
    light = draw_light(LightConfig(), np.random.default_rng(0))
    lit = cast_shadows(mesh, light).lit
    toward = light.lights[0, :3]
    facing = mesh.normals @ toward
    assert lit.min() == 0
    assert lit.max() == 1
    hand = slice(0, NUM_VERTICES)
    assert lit[hand][facing[hand] > 0.7].mean() > lit[hand][facing[hand] < -0.7].mean() + 0.3


def test_rotations_are_rotations_and_uniform():
    rng = np.random.default_rng(0)
    R = np.stack([random_rotation(rng) for _ in range(4000)])
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    np.testing.assert_allclose(R.mean(0), 0, atol=0.04)
    np.testing.assert_allclose(np.trace(R, axis1=1, axis2=2).var(), 1, atol=0.1)
