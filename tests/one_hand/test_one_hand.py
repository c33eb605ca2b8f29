"""The capture of one frame: it is sample 0 of the benchmark's seed 0, and its parts agree."""

import numpy as np

from poem_jax.capture.read import read_images
from poem_jax.capture.take import read_take
from poem_jax.data.lens import project_raw
from tests.one_hand.capture import one_hand_folder, one_hand_truth


def test_the_parts_agree():
    take = read_take(one_hand_folder())
    (frame,) = read_images(take.frames, take.rig)
    assert len(frame.images) == 4
    _, joints = one_hand_truth()
    for view in range(4):
        pixels, _ = project_raw(take.rig, view, joints[0])
        box = frame.boxes_px[0, view]
        np.testing.assert_allclose(box, [*pixels.min(0), *pixels.max(0)], atol=1e-2)


def test_it_is_the_benchmarks_first_sample():
    from poem_jax.experiments.synthetic_benchmark import benchmark
    from poem_jax.synthetic.dataset import SyntheticDataset

    scene = SyntheticDataset(benchmark, 0).draw_scene(0)
    vertices, _ = one_hand_truth()
    remake = "the hand or the benchmark has changed: run python -m tests.one_hand.make"
    np.testing.assert_allclose(vertices[0], scene.body.vertices_world, atol=1e-6, err_msg=remake)
    rig = read_take(one_hand_folder()).rig
    np.testing.assert_allclose(
        rig.T_cam_from_world, scene.viewpoints.T_cam_from_world[:4], atol=1e-9, err_msg=remake
    )
