"""The tiny archives agree with what was planted, read by plain means."""

import pickle

import cv2
import numpy as np
import pytest

from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import invert_rigid, transform_points
from poem_jax.hand.model import hand_mesh
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand
from poem_jax.miniatures.released_tars import KINDS, members_of

WORLD_TO_CAMERA = {"oakink", "arctic", "interhand"}
LESS_MEAN = {"arctic", "interhand"}
FIRST_TRAIN = {
    "dexycb": "DexYCB_mv/DexYCB_mv_train-000000.tar",
    "ho3d": "HO3D_mv/HO3D_mv_train-000000.tar",
    "oakink": "Oakink_mv/Oakink_mv_train+val-000000.tar",
    "arctic": "Arctic_mv/Arctic_mv_train_p1-000000.tar",
    "interhand": "Interhand_mv/Interhand_mv_train-000000.tar",
    "freihand": "Freihand_mv/Freihand_mv_train-000000.tar",
}


def samples_of(written):
    """Each planted frame with its members and label."""
    members = {name: data for path in written.root.rglob("*.tar") for name, data in members_of(path).items()}
    for frame in written.planted:
        mine = {name: data for name, data in members.items() if name.startswith(f"{frame.key_hint}.")}
        yield frame, mine, pickle.loads(mine[f"{frame.key_hint}.label.pyd"])


@pytest.mark.parametrize("name", KINDS)
def test_labels_agree_with_one_another_and_with_what_was_planted(miniature, name):
    written = miniature(f"tars-{name}")
    assert (written.root / FIRST_TRAIN[name]).is_file()
    for frame, members, label in samples_of(written):
        views = len(frame.view_names)
        assert {len(value) for field, value in label.items() if field != "request_flip"} == {views}
        K, joints, vertices = (np.array(label[field]) for field in ("cam_intr", "joints_3d", "verts_3d"))
        np.testing.assert_allclose(joints, frame.joints_cam, atol=1e-6)
        np.testing.assert_allclose(project_cam(K, joints), label["joints_2d"], atol=1e-2)
        np.testing.assert_allclose(np.array(label["joints_2d"]) + 0.5, frame.keypoints_px, atol=2e-3)
        # All cameras see one hand in one world.
        T = np.array(label["cam_extr"], np.float64)
        T_world_from_cam = invert_rigid(T) if name in WORLD_TO_CAMERA else T
        world = transform_points(T_world_from_cam, vertices.astype(np.float64))
        np.testing.assert_allclose(world, world[:1].repeat(views, 0), atol=1e-5)
        sizes = [cv2.imdecode(np.frombuffer(data, np.uint8), 1).shape[1::-1] for data in pictures(members)]
        assert len(sizes) == views
        assert np.array_equal(sizes, label["raw_size"])


def pictures(members):
    return [data for name, data in members.items() if ".image_" in name]


@pytest.mark.parametrize("name", KINDS)
def test_the_stored_pose_gives_the_stored_vertices(miniature, name):
    for frame, _, label in samples_of(miniature(f"tars-{name}")):
        if name == "oakink":
            assert not {"mano_pose", "mano_shape"} & set(label)
            continue
        pose = np.array(label["mano_pose"]).reshape(-1, 16, 3)
        if name in LESS_MEAN:
            pose[:, 1:] += stand_in_components().mean.reshape(15, 3)
        # The wrist does not depend on where tips are taken.
        mesh = hand_mesh(stand_in_hand(), pose, np.array(label["mano_shape"]), center_joint=0)
        vertices = mesh.vertices + frame.joints_cam[:, :1]
        np.testing.assert_allclose(vertices, label["verts_3d"], atol=2e-6)


@pytest.mark.parametrize("name", ["arctic", "interhand"])
def test_pictures_of_a_flipped_sample_show_the_mirror_image_of_its_labels(miniature, name):
    right, left = samples_of(miniature(f"tars-{name}"))
    assert (right[2]["request_flip"], left[2]["request_flip"]) == (False, True)
    for (frame, _, _), flip in ((right, False), (left, True)):
        for view, image in enumerate(frame.images):
            uv = project_cam(frame.K[view], frame.vertices_cam[view])
            mirror = np.stack([2 * frame.K[view, 0, 2] - uv[:, 0], uv[:, 1]], axis=-1)
            assert (redness(image, mirror) > redness(image, uv)) == flip


def redness(image, uv):
    """Red less blue at pixels: skin has more of it than the background."""
    columns, rows = np.clip(uv.astype(int), 0, np.array(image.shape[1::-1]) - 1).T
    return (image[rows, columns, 0].astype(float) - image[rows, columns, 2]).mean()


def test_the_box_is_that_of_the_key_points_but_for_two_cameras_of_ho3d_s_evaluation(miniature):
    for _, _, label in samples_of(miniature("tars-ho3d")):
        own = []
        for points, center, scale in zip(
            *(label[name] for name in ("joints_2d", "bbox_center", "bbox_scale")), strict=True
        ):
            low, high = points.min(0), points.max(0)
            same_center = (center == ((low + high) / 2).astype(int)).all()
            own.append(same_center and abs(scale - 2 * (high - low).max()) < 1e-3)
        evaluates = label["idx"][0] > 0
        assert own == [True, not evaluates, not evaluates, True, True]
