from collections import Counter

import numpy as np
import pytest

from poem_jax.hand import default_hand
from poem_jax.hand.topology import NUM_VERTICES, NUM_WRIST_EDGES
from poem_jax.synthetic.surfaces import (
    forearm_faces,
    grow_forearm,
    unit_box,
    unit_cylinder,
    unit_sphere,
    wrist_loop,
)


def directed_edges(faces):
    return Counter((int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3))


def is_closed(faces):
    edges = directed_edges(faces)
    return all(count == 1 and edges[(b, a)] == 1 for (a, b), count in edges.items())


def volume(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6


def grow(sleeve=False, bend=(0.0, 0.3, 0.0)):
    hand = default_hand()
    vertices = np.asarray(hand.v_template, np.float64)
    loop = wrist_loop(hand.faces)
    arm = grow_forearm(
        vertices[loop],
        np.asarray(hand.J_regressor, np.float64)[4] @ vertices,
        forearm_faces(loop, NUM_VERTICES),
        length=0.2,
        bend=np.array(bend),
        taper=1.3,
        sleeve=sleeve,
    )
    return hand, vertices, arm


def test_the_wrist_loop_is_the_boundary_in_order():
    faces = default_hand().faces
    loop = wrist_loop(faces)
    assert len(loop) == NUM_WRIST_EDGES
    edges = directed_edges(faces)
    for a, b in zip(loop, np.roll(loop, -1), strict=True):
        assert edges[(int(a), int(b))] == 1
        assert edges[(int(b), int(a))] == 0


@pytest.mark.parametrize("sleeve", [False, True])
def test_hand_and_forearm_are_one_closed_surface(sleeve):
    hand, vertices, arm = grow(sleeve)
    faces = np.concatenate([hand.faces, arm.faces])
    assert arm.faces.max() == NUM_VERTICES + len(arm.vertices) - 1
    assert is_closed(faces)
    everything = np.concatenate([vertices, arm.vertices])
    assert volume(everything, faces) > 2 * 0.2 * 0.02 * 0.02
    assert arm.sleeve.max() == float(sleeve)


def test_the_arm_leads_away_from_the_hand_and_bends():
    _, vertices, straight = grow(bend=(0.0, 0.0, 0.0))
    _, _, bent = grow(bend=(0.0, 0.0, 0.6))
    hand = vertices.mean(0)
    loop = vertices[wrist_loop(default_hand().faces)].mean(0)
    axis = straight.vertices[-1] - loop
    assert np.linalg.norm(axis) == pytest.approx(0.2, rel=0.02)
    assert axis @ (loop - hand) > 0
    turned = bent.vertices[-1] - loop
    cosine = axis @ turned / np.linalg.norm(axis) / np.linalg.norm(turned)
    assert 0.05 < np.arccos(cosine) < 0.61


@pytest.mark.parametrize("make", [unit_box, unit_cylinder, unit_sphere])
def test_solids_are_closed_and_their_normals_point_outwards(make):
    solid = make()
    places = np.unique(solid.vertices.round(9), axis=0, return_inverse=True)[1].ravel()
    assert is_closed(places[solid.faces])
    a, b, c = solid.vertices[solid.faces].transpose(1, 0, 2)
    flat = np.cross(b - a, c - a)
    assert (np.einsum("fi,fi->f", flat, (a + b + c) / 3) > 0).all()
    mean = solid.normals[solid.faces].mean(1)
    assert (np.einsum("fi,fi->f", flat, mean) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(solid.normals, axis=-1), 1)


def test_volumes_of_solids():
    assert volume(unit_box().vertices, unit_box().faces) == pytest.approx(8)
    assert volume(unit_cylinder().vertices, unit_cylinder().faces) == pytest.approx(2 * np.pi, rel=0.05)
    assert volume(unit_sphere().vertices, unit_sphere().faces) == pytest.approx(4 / 3 * np.pi, rel=0.1)


def test_hands_without_one_wrist_loop_are_refused():
    solid = unit_sphere()
    with pytest.raises(ValueError, match="must be open at the wrist"):
        wrist_loop(solid.faces)
    with pytest.raises(ValueError, match="one wrist loop; got 6 boundary edges, 3 in one"):
        wrist_loop(np.array([[0, 1, 2], [3, 4, 5]]))
