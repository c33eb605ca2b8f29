"""InterHand2.6M: single hands in a dome of some eighty cameras, of which a sample shows eight.

Layout (the set's own page, mks0601.github.io/InterHand2.6M, and its tools, tool/MANO_world_to_camera in
github.com/facebookresearch/InterHand2.6M): `annotations/<split>/InterHand2.6M_<split>_<part>.json` with the
parts data, camera, joint_3d and MANO_NeuralAnnot, and
`images/<split>/Capture<n>/<sequence>/cam<camera>/image<frame>.jpg`. Frames are numbered through a whole
capture, so (capture, frame) names one.

Conventions: world millimetres; x_cam = camrot (x_world - campos); joints from the tip to the base of each
finger, thumb first, wrist last, right hand before left. The pose has 48 numbers, in the world, relative to
the mean (`flat_hand_mean` False). As the released code does, MANO's hand is put at the labelled wrist, and
its own `trans` is not used. Pixels count from the centre of the first, so K gets half a pixel here; key
points are the projected joints. Which frames count: `interhand_index.py`.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.data.frames import CorruptSampleError, MultiViewFrame, check_frame
from poem_jax.data.right_hand import as_right_hand
from poem_jax.data.sources.hand_in_views import ManoFile, hand_in_views, span_intrinsics
from poem_jax.data.sources.interhand_index import AnnotationFiles, FrameIndex, open_index
from poem_jax.data.sources.raw_sets import (
    check_choice,
    check_mesh,
    find_folder,
    identify,
    identify_list,
    need_file,
    numbers,
    read_image,
)
from poem_jax.geometry.cameras import project_cam
from poem_jax.geometry.transforms import rigid
from poem_jax.hand.joint_orders import JOINT_ORDERS
from poem_jax.io.json_file import read_json
from poem_jax.typing import Array, Float, Int

OPENPOSE_FROM_INTERHAND = JOINT_ORDERS[
    "thumb to little finger, each from tip to base, then the wrist (InterHand2.6M)"
]
_MM = 1e-3
_FIT_APART_M = 0.05
"""Bound on the distance of MANO's joints from the labelled ones: people and a network marked these, and MANO
was fitted to them."""
_NAMES = (
    "InterHand2.6M",
    "InterHand2.6M_5fps_batch1",
    "InterHand2.6M/InterHand2.6M_5fps_batch1",
    "InterHand",
)
_ADVICE = "InterHand2.6M v1.0 is at mks0601.github.io/InterHand2.6M (images and annotations)."


class InterHand:
    """One split of InterHand2.6M, one hand alone; see the module.

    The paper's groups of eight views were drawn at random, and its draw is not public. Here every frame's
    cameras are put into an order drawn from (seed, capture, frame), whatever else is in the split, and cut
    into groups; another seed is another draw. The paper counts 85,255 groups in val: times 8 they exceed
    val's images at 5 fps, so it used cameras more than once or took the images at 30 fps.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        split: str = "train",
        views: int = 8,
        seed: int = 0,
        mano: str | Path,
        hand: str = "right",
        draws: int = 1,
    ) -> None:
        """Open the set and list its samples; the first time, that takes minutes.

        Args:
            root: The folder that holds `annotations/` and `images/`, or one that holds it under its usual
                name.
            split: "train", "val" (the paper's test set) or "test".
            views: Cameras of a sample; frames with fewer give all they have.
            seed: Of the draw.
            mano: The user's MANO_RIGHT.pkl; for left hands MANO_LEFT.pkl.
            hand: "right" (the paper's), or "left": frames of left hands alone, given as right ones.
            draws: Samples of a frame, no camera twice; a group that would be short is left out unless it is
                the first.

        Raises:
            FileNotFoundError: A folder or file is missing.
            ValueError: An unknown option, or an annotation file that is not as it should be.
        """
        check_choice("split", split, ("train", "val", "test"))
        check_choice("hand", hand, tuple(_SIDE_WORDS))
        if min(views, draws) < 1 or seed < 0:
            raise ValueError(
                f"`views` and `draws` must be positive and `seed` not negative; got {views}, {draws}, {seed}"
            )
        folder = find_folder(root, _NAMES, f"annotations/{split}", advice=_ADVICE)
        annotations = folder / "annotations" / split
        self._files = AnnotationFiles.of(annotations, split)
        for path in self._files:
            need_file(path, f"an annotation file of {split}", advice=_ADVICE)
        self._camera_file = need_file(
            annotations / f"InterHand2.6M_{split}_camera.json", f"the cameras of {split}", advice=_ADVICE
        )
        self._images = folder / "images" / split
        if not self._images.is_dir():
            raise FileNotFoundError(f"the images are missing: expected {self._images}. {_ADVICE}")
        self._mano, self._hand = ManoFile.open(mano, side=hand), hand
        self._cameras = _read_cameras(self._camera_file)
        self._views, self._seed, self._draws = views, seed, draws
        self.name, self.max_views = f"interhand {split}{_SIDE_WORDS[hand]} seed {seed}", views
        self._starts = self._number_samples()

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> MultiViewFrame:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name} has samples 0 to {len(self) - 1}; got {index}")
        which = int(np.searchsorted(self._starts, index, side="right")) - 1
        held = self._index()
        labels, draw = held.frames[which], int(index - self._starts[which])
        capture, number = int(labels["capture"]), int(labels["frame"])
        key = f"Capture{capture}/{number}" + (f"/{draw}" if self._draws > 1 else "")
        views = held.views[labels["start"] : labels["stop"]][self._drawn(labels, draw)]
        names = tuple(view["camera"].decode() for view in views)
        K, T = self._cameras_of(capture, names, key)
        joints = labels["joints_mm"].astype(np.float64)[list(OPENPOSE_FROM_INTERHAND)] * _MM
        pose = self._mano.add_mean(labels["pose"])
        mesh = self._mano.mesh(pose, labels["shape"], wrist_at=joints[0])
        check_mesh(mesh.joints[None], joints[None], self._files.mano, key, max_apart_m=_FIT_APART_M)
        hand = hand_in_views(T, joints, mesh.vertices, pose, labels["shape"])
        frame = MultiViewFrame(
            key=key,
            images=tuple(read_image(self._images / view["file"].decode(), key) for view in views),
            view_names=names,
            size_wh=views["size_wh"].astype(np.int64),
            K=K,
            T_cam_from_world=T,
            joints_cam=hand.joints_cam,
            vertices_cam=hand.vertices_cam,
            keypoints_px=project_cam(K, hand.joints_cam),
            pose_cam=hand.pose_cam,
            shape=hand.shape,
        )
        return check_frame(frame if self._hand == "right" else as_right_hand(frame), self._files.joint_3d)

    def fingerprint(self) -> dict[str, str]:
        """Return what identifies the list of samples. The annotations are too large to be read for it: the
        frames found in them stand for them."""
        frames = self._index().frames
        keys = (f"{row['capture']}/{row['frame']} {row['stop'] - row['start']}" for row in frames)
        return {
            str(self._camera_file): identify(self._camera_file),
            "frames": identify_list(keys),
            "draw": f"{self._views} views, {self._draws} draws, seed {self._seed}",
        }

    def _index(self) -> FrameIndex:
        return open_index(self._files, self._hand)

    def _number_samples(self) -> Int[Array, " start"]:
        """Return the index of each frame's first sample, and one more at the end."""
        frames = self._index().frames
        if not len(frames):
            raise ValueError(f"{self._files.data.parent} has no frame of a {self._hand} hand alone")
        counts = np.clip((frames["stop"] - frames["start"]) // self._views, 1, self._draws)
        return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def _drawn(self, labels: Any, draw: int) -> Int[Array, " chosen"]:
        """Return which of a frame's cameras a sample shows, in drawn order."""
        rng = np.random.default_rng([self._seed, int(labels["capture"]), int(labels["frame"])])
        order = rng.permutation(int(labels["stop"] - labels["start"]))
        return order[draw * self._views : (draw + 1) * self._views]

    def _cameras_of(
        self, capture: int, names: tuple[str, ...], key: str
    ) -> tuple[Float[Array, "view 3 3"], Float[Array, "view 4 4"]]:
        rig = self._cameras.get(str(capture), {})
        missing = [name for name in names if name not in rig]
        if missing:
            raise CorruptSampleError(
                self._camera_file, key, f"capture {capture} must have cameras {', '.join(missing)}"
            )
        return np.stack([rig[name].K for name in names]), np.stack([rig[name].T for name in names])


_SIDE_WORDS = {"right": "", "left": " left hands"}


class _Camera(NamedTuple):
    K: Float[Array, "3 3"]
    T: Float[Array, "4 4"]
    """`T_cam_from_world`."""


_CAMERA_SHAPES = {"campos": (3,), "camrot": (3, 3), "focal": (2,), "princpt": (2,)}


def _read_cameras(path: Path) -> dict[str, dict[str, _Camera]]:
    """Return the cameras of each capture by name."""
    captures = read_json(path, what="file of cameras")
    if not isinstance(captures, dict) or not all(isinstance(held, dict) for held in captures.values()):
        raise ValueError(f"{path} must hold an object of captures")
    return {capture: _read_rig(held, f"{path}, capture {capture}") for capture, held in captures.items()}


def _read_rig(held: dict[str, Any], where: str) -> dict[str, _Camera]:
    fields = {name: held.get(name) for name in _CAMERA_SHAPES}
    if not all(isinstance(field, dict) for field in fields.values()):
        raise ValueError(f"{where}: it must have {', '.join(_CAMERA_SHAPES)}, each by camera")
    cameras = {}
    for name in held["campos"]:
        parts = {}
        for field, shape in _CAMERA_SHAPES.items():
            parts[field] = numbers(held[field].get(name, []), shape, f"{where}: `{field}` of camera {name}")
        (fx, fy), (cx, cy), R = parts["focal"], parts["princpt"], parts["camrot"]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        cameras[name] = _Camera(span_intrinsics(K), rigid(R, -R @ parts["campos"] * _MM))
    return cameras
