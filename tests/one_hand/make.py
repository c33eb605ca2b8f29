"""Make the capture of one frame: `python -m tests.one_hand.make [--out tests/one_hand]`.

Sample 0 of seed 0 of the synthetic benchmark, its first four cameras, drawn as pictures of 512 x 512 that
show more around the hand than the benchmark's crops do. The same on every run.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture.boxes_file import HandBoxes, boxes_from_keypoints, write_boxes
from poem_jax.data.transforms import box_from_center
from poem_jax.experiments.synthetic_benchmark import benchmark
from poem_jax.geometry.cameras import crop_homography, crop_intrinsics, invert_intrinsics, project
from poem_jax.geometry.rig import Rig
from poem_jax.io.atomic import whole_file
from poem_jax.synthetic.dataset import Scene, SyntheticDataset, render_view
from tests.one_hand.capture import GROUND_TRUTH, one_hand_folder

SEED, INDEX, NUM_VIEWS = 0, 0, 4
SIDE = 512
WIDER = 2.2
"""Side of a picture over that of the benchmark's crop."""
JPEG_QUALITY = 92


def picture_boxes(scene: Scene) -> np.ndarray:
    """Return where the pictures lie in the full frames, (view, 4)."""
    box = scene.viewpoints.box_px[:NUM_VIEWS]
    return box_from_center((box[:, :2] + box[:, 2:]) / 2, WIDER * (box[:, 2] - box[:, 0]))


def draw_picture(dataset: SyntheticDataset, scene: Scene, view: int, box: np.ndarray) -> np.ndarray:
    """Render one picture; blur and background keep their size on the hand."""
    at = scene.viewpoints
    hw = (SIDE, SIDE)
    H_picture_from_frame = crop_homography(box, hw)
    H_crop_from_frame = crop_homography(at.box_px[view], dataset.config.image_hw)
    H_crop_from_picture = H_crop_from_frame @ invert_intrinsics(H_picture_from_frame)
    finer = SIDE / (WIDER * dataset.config.image_hw[0])
    exposure = scene.exposures[view]
    exposure = exposure._replace(
        warp=(np.vstack([exposure.warp, [0, 0, 1]]) @ H_crop_from_picture)[:2],
        blur_px=exposure.blur_px * finer,
        motion_px=round(exposure.motion_px * finer),
    )
    width, height = at.frame_wh[view]
    corners = np.array([[0, 0, 1], [width, height, 1]]) @ H_picture_from_frame.T
    rendered = render_view(
        scene,
        K=crop_intrinsics(at.K_frame[view], box, hw),
        T_cam_from_world=at.T_cam_from_world[view],
        full_frame=corners[:, :2].ravel(),
        exposure=exposure,
        background=dataset.backgrounds[exposure.background],
        hw=hw,
        scale=dataset.config.supersample,
    )
    return rendered.image


def write_capture(out: Path) -> None:
    """Write images, rig, boxes and truth."""
    dataset = SyntheticDataset(benchmark, SEED)
    scene = dataset.draw_scene(INDEX)
    boxes = picture_boxes(scene)
    names = tuple(f"cam_{view}" for view in range(NUM_VIEWS))
    for view, name in enumerate(names):
        image = draw_picture(dataset, scene, view, boxes[view])
        data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        with whole_file(out / f"{name}.jpg") as temporary:
            temporary.write_bytes(data.tobytes())
    K = crop_intrinsics(scene.viewpoints.K_frame[:NUM_VIEWS], boxes, (SIDE, SIDE))
    T = scene.viewpoints.T_cam_from_world[:NUM_VIEWS]
    write_rig(out / "rig.json", Rig(names, np.full((NUM_VIEWS, 2), SIDE), K, np.zeros((NUM_VIEWS, 5)), T))
    joints = scene.body.joints_world.astype(np.float64)
    keypoints_px, _ = project(K, T, np.broadcast_to(joints, (NUM_VIEWS, *joints.shape)))
    write_boxes(out / "boxes.npz", HandBoxes(boxes_from_keypoints(keypoints_px)[None, None], ("right",)))
    truth = {"vertices_world": scene.body.vertices_world[None], "joints_world": scene.body.joints_world[None]}
    np.savez_compressed(out / GROUND_TRUTH, **truth)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=one_hand_folder())
    write_capture(parser.parse_args().out)
