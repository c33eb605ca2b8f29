"""The bundled capture: it is sample 0 of the benchmark's seed 0, and its parts agree."""

from pathlib import Path

import numpy as np
import pytest

from poem_jax.capture.demo import demo_folder, ground_truth, mpvpe_mm
from poem_jax.capture.read import read_images
from poem_jax.capture.take import read_take
from poem_jax.data.lens import project_raw

ROOT = Path(__file__).resolve().parents[2]


def test_the_parts_agree():
    take = read_take(demo_folder())
    (frame,) = read_images(take.frames, take.rig)
    assert len(frame.images) == 4
    vertices, joints = ground_truth()
    for view in range(4):
        pixels, _ = project_raw(take.rig, view, joints[0])
        box = frame.boxes_px[0, view]
        np.testing.assert_allclose(box, [*pixels.min(0), *pixels.max(0)], atol=1e-2)
    truth = {"vertices_world": vertices[:, None], "joints_world": joints[:, None]}
    assert mpvpe_mm(truth) == pytest.approx(0, abs=1e-6)
    shifted = {name: array + np.array([0.003, 0, 0.004]) for name, array in truth.items()}
    assert mpvpe_mm(shifted) == pytest.approx(5, abs=1e-3)


def test_it_is_the_benchmarks_first_sample():
    from poem_jax.experiments.synthetic_benchmark import benchmark
    from poem_jax.synthetic.dataset import SyntheticDataset

    scene = SyntheticDataset(benchmark, 0).draw_scene(0)
    vertices, _ = ground_truth()
    remake = "the hand or the benchmark has changed: run tools/make_demo.py"
    np.testing.assert_allclose(vertices[0], scene.body.vertices_world, atol=1e-6, err_msg=remake)
    rig = read_take(demo_folder()).rig
    np.testing.assert_allclose(
        rig.T_cam_from_world, scene.viewpoints.T_cam_from_world[:4], atol=1e-9, err_msg=remake
    )
