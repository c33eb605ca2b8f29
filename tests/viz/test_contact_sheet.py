"""Contact sheets: joints and outline lie where the labels are, and what cannot be decoded is said."""

import cv2
import numpy as np
import pytest

from poem_jax.data.frames import EncodedImage
from poem_jax.data.transforms import square_box
from poem_jax.geometry.cameras import crop_homography, project_cam, transform_pixels
from poem_jax.hand.template import default_hand
from poem_jax.viz.contact_sheet import AROUND_HAND, contact_sheet, write_contact_sheet
from tests.data.one_frame import SIZE_WH, one_frame

TILE = 128
LABEL = 18


@pytest.fixture(scope="module")
def frame():
    ok, grey = cv2.imencode(".png", np.full((*SIZE_WH[::-1], 3), 40, np.uint8))
    assert ok
    made = one_frame(views=3)
    return made._replace(images=tuple(EncodedImage(grey.tobytes(), name) for name in made.view_names))


def tile_of(sheet, view, row=0):
    top = row * (TILE + 2 * LABEL) + LABEL
    return sheet[top : top + TILE, view * TILE : (view + 1) * TILE]


def in_tile(frame, view, points_px):
    square = square_box(frame.keypoints_px[view], AROUND_HAND)
    return transform_pixels(crop_homography(square, (TILE, TILE)), points_px)


def coloured(tile):
    return np.ptp(tile.astype(int), axis=-1) > 60


def test_joints_are_drawn_at_the_stored_key_points(frame):
    sheet = contact_sheet([frame], tile_px=TILE)
    for view in range(3):
        tips = in_tile(frame, view, frame.keypoints_px[view])[[4, 8, 12, 16, 20]]
        for u, v in tips:
            assert coloured(tile_of(sheet, view))[int(v), int(u)]
    moved = frame._replace(keypoints_px=frame.keypoints_px + np.array([12.0, 0]), box_px=None)
    assert not np.array_equal(contact_sheet([moved], tile_px=TILE), sheet)


@pytest.mark.parametrize("faces", [None, default_hand().faces])
def test_the_outline_is_that_of_the_projected_vertices(frame, faces):
    far = frame._replace(keypoints_px=frame.keypoints_px * 0 + np.array([[5.0, 5.0]]) + np.eye(21, 2) * 3)
    far = far._replace(box_px=np.stack([square_box(uv, 1.0) for uv in frame.keypoints_px]))
    tile = tile_of(contact_sheet([far], faces=faces, tile_px=TILE), 0)
    white = (tile == 255).all(-1)
    vertices = in_tile(frame, 0, project_cam(frame.K[0], frame.vertices_cam[0]))
    filled = np.zeros((TILE, TILE), np.uint8)
    contours, _ = cv2.findContours(white.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(filled, contours, -1, 1, -1)
    # Vertices on the silhouette lie up to a pixel beyond the outermost pixel centre that it covers.
    widened = cv2.dilate(filled, np.ones((3, 3), np.uint8))
    assert np.mean([widened[int(v), int(u)] for u, v in vertices]) > 0.99
    assert 0.5 < filled.sum() / cv2.contourArea(cv2.convexHull(vertices.astype(np.float32))) < 1


def test_a_mirrored_image_is_shown_mirrored(frame):
    half = np.zeros((*SIZE_WH[::-1], 3), np.uint8)
    half[:, : SIZE_WH[0] // 2] = 200
    data = cv2.imencode(".png", half)[1].tobytes()
    shown = frame._replace(images=tuple(EncodedImage(data, "half") for _ in range(3)))
    turned = shown._replace(mirror_px=np.full(3, SIZE_WH[0] / 2))
    for view in range(3):
        plain, mirrored = (
            tile_of(contact_sheet([f], tile_px=TILE), view).min(-1) == 200 for f in (shown, turned)
        )
        where = in_tile(frame, view, np.array([[SIZE_WH[0] / 2, 100.0]]))[0, 0]
        columns = np.arange(TILE) + 0.5
        left, right = columns < where - 2, columns > where + 2
        if left.any():
            assert plain[:, left].mean() > mirrored[:, left].mean()
        if right.any():
            assert plain[:, right].mean() < mirrored[:, right].mean()


def test_an_image_that_cannot_be_decoded_is_named(frame, caplog):
    broken = frame._replace(images=(EncodedImage(b"\xff\xd8\xff", "a.jpg"), *frame.images[1:]))
    sheet = contact_sheet([frame, broken], tile_px=TILE)
    assert "a.jpg" in caplog.text
    assert frame.key in caplog.text
    assert not np.array_equal(tile_of(sheet, 0, 0), tile_of(sheet, 0, 1))
    assert np.array_equal(tile_of(sheet, 1, 0), tile_of(sheet, 1, 1))


def test_a_sheet_has_a_row_a_sample_and_is_written_as_png(frame, tmp_path):
    path = write_contact_sheet(tmp_path / "sheet.png", [frame, frame])
    assert cv2.imread(str(path)).shape == (2 * (256 + 2 * LABEL), 3 * 256, 3)
    with pytest.raises(ValueError, match="at least one sample"):
        contact_sheet([])
