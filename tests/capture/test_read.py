"""Images that are lost: a take goes on without them, and says so."""

import cv2
import numpy as np
import pytest

from poem_jax.capture.boxes_file import write_boxes
from poem_jax.capture.read import read_images
from poem_jax.capture.take import read_take


def test_bad_images_do_not_stop_a_take(make_capture, tmp_path, run, caplog):
    capture = make_capture(3)
    places = [capture.folder / "frames" / name for name in ("0000", "0003", "0006")]
    (places[0] / "front.png").unlink()
    (places[1] / "front.png").write_bytes(b"broken")
    for path in places[2].glob("*.png"):
        path.write_bytes(b"broken")
    written = run(capture, tmp_path / "out")
    assert written.arrays["valid"][:, 0].tolist() == [True, True, False]
    assert written.arrays["views_used"][:2, 0].tolist() == [[True, False, True]] * 2
    missing, broken, gone = written.report["frames"]
    assert "camera 'front' has a box but no image" in missing["image_problems"][0]
    assert "cannot be read as an image" in broken["image_problems"][0]
    assert len(gone["image_problems"]) == 3
    assert gone["hands"][0]["reason"] == "seen in 0 view(s); two are needed"
    assert written.report["failed_frames"] == 1
    assert not (tmp_path / "out" / "0006").exists()
    assert "frame 0003: an image is left out" in caplog.text


@pytest.mark.parametrize("num_frames", [1, 2])
def test_a_broken_image_that_nothing_needs_is_noted(make_capture, tmp_path, run, num_frames):
    capture = make_capture(num_frames)
    capture.hands.boxes_px[:, :, 1] = np.nan
    write_boxes(capture.folder / "boxes.npz", capture.hands)
    for path in capture.folder.rglob("front.png"):
        path.write_bytes(b"broken")
    written = run(capture, tmp_path / "out")
    assert written.arrays["valid"].all()
    assert written.report["failed_frames"] == 0
    assert "cannot be read as an image" in written.report["frames"][0]["image_problems"][0]
    assert not list((tmp_path / "out").rglob("overlay_front.png"))


def test_the_only_frame_raises(make_capture, tmp_path, run):
    capture = make_capture()
    (capture.folder / "front.png").unlink()
    with pytest.raises(FileNotFoundError, match="camera 'front' has a box but no image"):
        run(capture, tmp_path / "out")
    (capture.folder / "front.png").write_bytes(b"broken")
    with pytest.raises(ValueError, match="cannot be read as an image"):
        run(capture, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def warn_of(capture):
    take = read_take(capture.folder)
    (frame,) = read_images(take.frames, take.rig)
    return frame


def test_an_image_of_one_colour_is_left_out_with_a_warning(make_capture):
    capture = make_capture()
    black = np.zeros((180, 240, 3), np.uint8)
    black[::7] = 1  # Noise of a sensor behind a covered lens.
    cv2.imwrite(str(capture.folder / "front.png"), black)
    frame = warn_of(capture)
    assert [image is None for image in frame.images] == [False, True, False]
    assert frame.warnings == ("the image of camera 'front' shows nothing but one colour: it is left out",)
    assert not frame.problems[0].needed, "the take goes on, even if it is one frame"


def test_copied_images_are_told_if_they_are_compressed_again(make_capture):
    capture = make_capture()
    image = cv2.imread(str(capture.folder / "front.png"))
    (capture.folder / "cam 3.png").unlink()
    cv2.imwrite(str(capture.folder / "cam 3.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 80])
    frame = warn_of(capture)
    (warning,) = frame.warnings
    assert "cameras 'front' and 'cam 3' have the same image" in warning
    assert all(image is not None for image in frame.images)


def test_images_of_several_cameras_are_not_complained_about(make_capture):
    frame = warn_of(make_capture())
    assert frame.warnings == ()
    assert frame.problems == ()
