"""A small rig, captures on disk, and a model small enough to compile in seconds."""

from typing import NamedTuple

import cv2
import numpy as np
import pytest

from poem_jax.calibration.rig_json import write_rig
from poem_jax.capture.boxes_file import HandBoxes, write_boxes
from poem_jax.data.lens import project_raw
from tests.rigs import small_rig


@pytest.fixture
def rig():
    return small_rig()


class Capture(NamedTuple):
    folder: object
    hands: HandBoxes
    joints_world: np.ndarray


def draw_image(rig, view, points_world, seed=0):
    """A smooth random picture with a soft dot at every point."""
    width, height = rig.size_wh[view]
    noise = np.random.default_rng(seed + view).integers(0, 255, (12, 16, 3)).astype(np.uint8)
    image = cv2.resize(noise, (int(width), int(height)), interpolation=cv2.INTER_CUBIC)
    for u, v in project_raw(rig, view, points_world)[0]:
        cv2.circle(image, (round(u - 0.5), round(v - 0.5)), 3, (250, 240, 230), -1)
    return image


@pytest.fixture
def make_capture(tmp_path, rig):
    """Write a capture: `make_capture(num_frames, sides)`; one frame is written without `frames/`."""

    def make(num_frames=1, sides=("right",), rig=rig, keypoints=False, name="capture"):
        folder = tmp_path / name
        rng = np.random.default_rng(0)
        shape = (num_frames, len(sides))
        centres = rng.uniform(-0.04, 0.04, (*shape, 1, 3))
        joints = centres + rng.uniform(-0.05, 0.05, (*shape, 21, 3))
        uv = np.zeros((*shape, 3, 21, 2))
        for frame in range(num_frames):
            place = folder if num_frames == 1 else folder / "frames" / f"{3 * frame:04d}"
            place.mkdir(parents=True)
            for view, camera in enumerate(rig.names):
                for hand in range(len(sides)):
                    uv[frame, hand, view] = project_raw(rig, view, joints[frame, hand])[0]
                image = draw_image(rig, view, joints[frame].reshape(-1, 3))
                cv2.imwrite(str(place / f"{camera}.png"), image[..., ::-1])
        boxes = np.concatenate([uv.min(-2), uv.max(-2)], axis=-1)
        names = tuple(str(3 * frame) for frame in range(num_frames)) if num_frames > 1 else None
        hands = HandBoxes(boxes, tuple(sides), names, uv if keypoints else None)
        write_boxes(folder / "boxes.npz", hands)
        write_rig(folder / "rig.json", rig)
        return Capture(folder, hands, joints)

    return make


@pytest.fixture(scope="session")
def network(micro_model):
    from poem_jax.capture.network import make_network

    return make_network(*micro_model)


@pytest.fixture
def run(network):
    """Run the line over a capture on disk: `run(capture, out, network=..., meshes=...)`."""
    from poem_jax.capture.pipeline import reconstruct
    from poem_jax.capture.take import read_take

    def start(capture, out, **options):
        return reconstruct(
            read_take(capture.folder),
            out,
            **{"engine": "poem", "network": network, "progress": False, **options},
        )

    return start
