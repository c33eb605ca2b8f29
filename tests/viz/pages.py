"""A small take for the page: four cameras around a point, hands there, and pictures of one colour each."""

import numpy as np

from poem_jax.geometry.cameras import project
from poem_jax.hand.joint_weights import vertex_joint_weights
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.template import default_hand
from poem_jax.viz.page import PageCamera, PageFrame, PageHand, encode_picture

CENTRE = np.array([0.3, -0.2, 1.0])
FACES = {side: default_hand(side).faces for side in ("right", "left")}
PICTURE_HW = (90, 160)
GREYS = (200, 150, 100, 50)


def joint_weights():
    model = default_hand("right")
    return vertex_joint_weights(model.v_template, model.J_regressor, model.weights)


def cameras():
    made = []
    for i, turn in enumerate([0.0, 1.2, 2.5, 4.0]):
        place = CENTRE + 0.7 * np.array([np.cos(turn), np.sin(turn), 0.4])
        z = (CENTRE - place) / np.linalg.norm(CENTRE - place)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(z, x), z])
        T[:3, 3] = -T[:3, :3] @ place
        made.append(PageCamera(f"cam_{i}", T, 200.0, PICTURE_HW))
    return made


def K_of(camera):
    height, width = camera.hw
    return np.array([[camera.focal_px, 0, width / 2], [0, camera.focal_px, height / 2], [0, 0, 1]])


def posed(side="right", seed=0):
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.normal(size=(1, 3)), 0.15 * rng.normal(size=(15, 3))])
    return hand_mesh(default_hand(side), pose, np.zeros(10), CENTRE)


def hand(side="right", seed=0):
    return posed(side, seed).vertices


def page_hand(side="right", seed=0, shift=(0, 0, 0), **more):
    """A hand with the key points that its joints project to."""
    mesh = posed(side, seed)
    joints = mesh.joints + np.asarray(shift)
    seen = np.stack([project(K_of(c), c.T_cam_from_world, joints)[0] for c in cameras()])
    known = {"keypoints_px": seen, "error_px": np.full((4, 21), 2.0), "sigma_m": np.full(21, 0.003)}
    return PageHand(mesh.vertices + np.asarray(shift), joints, **{**known, **more})


def frames(number=1, step_m=0.01, timed=False):
    """Frames in which a right hand moves along x."""
    pictures = [encode_picture(np.full((*PICTURE_HW, 3), grey, np.uint8)) for grey in GREYS]
    return [
        PageFrame(
            f"{3 * i:04d}",
            {"right": page_hand(shift=(step_m * i, 0, 0))},
            pictures,
            0.1 * i if timed else None,
        )
        for i in range(number)
    ]
