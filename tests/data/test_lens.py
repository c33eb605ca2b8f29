"""What a stored image shows of a view, through its lens and its mirror, lands where the labels say."""

import cv2
import numpy as np
import pytest

from poem_jax.data.augmentation import PAPER, RELEASE_V1, RELEASE_V2, draw, transform
from poem_jax.data.frames import EncodedImage
from poem_jax.data.lens import stored_picture_map, take_picture
from poem_jax.geometry.cameras import crop_homography, project_cam, transform_pixels
from poem_jax.geometry.distortion import distort_pixels
from tests.data.one_frame import one_frame

K_STORED = np.array([[300.0, 0.7, 151], [0, 310, 126], [0, 0, 1]])
DIST = np.array([-0.3, 0.05, -0.004, 0.004, 0.06])
HW = (240, 320)


def dot(centre_px):
    v, u = np.meshgrid(np.arange(HW[0]) + 0.5, np.arange(HW[1]) + 0.5, indexing="ij")
    value = 255 * np.exp(-((u - centre_px[0]) ** 2 + (v - centre_px[1]) ** 2) / 12.5)
    return np.repeat(np.rint(value).astype(np.uint8)[..., None], 3, -1)


def centroid(image):
    weight = image[..., 0].astype(np.float64)
    v, u = np.meshgrid(np.arange(image.shape[0]) + 0.5, np.arange(image.shape[1]) + 0.5, indexing="ij")
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


@pytest.mark.parametrize("dist", [None, DIST])
@pytest.mark.parametrize("mirror_px", [None, 151.0, 160.0])
def test_a_point_of_the_stored_image_lands_where_its_label_does(dist, mirror_px):
    ideal = np.array([[205.0, 90.0]])
    raw = ideal if dist is None else distort_pixels(ideal, K_STORED, dist)
    K = K_STORED.copy()
    if mirror_px is not None:
        ideal = np.array([[2 * mirror_px, 0]]) + ideal * [-1, 1]
        K[0, 1], K[0, 2] = -K[0, 1], 2 * mirror_px - K[0, 2]
    box = np.array([*(ideal[0] - [40, 30]), *(ideal[0] + [30, 40])])
    H = crop_homography(box, (112, 112))
    where = stored_picture_map(K, dist, mirror_px, H @ K, (112, 112), 0.6)
    seen = centroid(take_picture(dot(raw[0]), where))
    assert np.allclose(seen, transform_pixels(H, ideal)[0], atol=0.15)


@pytest.mark.parametrize("recipe", [PAPER, RELEASE_V1, RELEASE_V2])
def test_augmented_crops_are_sampled_through_the_lens(recipe):
    frame = one_frame(views=1, skew=0.0)
    K = np.array([[[300.0, 0, 151], [0, 300, 126], [0, 0, 1]]])
    target = project_cam(K, frame.joints_cam)
    strong = np.array([8.0, 0, 0.03, 0.03, 0])
    raw = distort_pixels(target[0], K[0], strong)
    joint = np.linalg.norm(raw - target[0], axis=-1).argmax()
    assert np.linalg.norm(raw[joint] - target[0, joint]) > 1
    data = cv2.imencode(".png", dot(raw[joint]))[1].tobytes()
    frame = frame._replace(
        K=K, keypoints_px=target, dist=strong[None], images=(EncodedImage(data, "dot"),), box_px=None
    )
    draws = draw(recipe, 1, np.random.default_rng(1))._replace(occluded=np.array([False]))
    sample = transform(frame, np.array([0]), draws, recipe, (192, 192))
    assert np.allclose(centroid(sample.views[0]), sample.keypoints_px[0, joint], atol=0.3)
