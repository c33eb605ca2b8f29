"""A tiny OakInk-Image: layout of `docs/datasets.md` and `oikit` of github.com/oakink/OakInk.

    image/stream_release_v2/<seq_id>/<timestamp>/<view>_<frame>.png
    image/anno/{seq_all, seq_status}.json, {cam_intr, hand_j, hand_v, general_info, obj_transf}/<sample>.pkl
    image/anno/split*/..., split_train_val/split*/...    lists of [seq_id/timestamp, person, frame, view]
    image/anno_mv/...                                    the same lists with all four views of every frame
    image/anno_packed_mv/<object|subject>/<split>/<sample>.pkl
    image/obj/<object>.obj

`cam_extr` is world -> camera, `hand_j` and `hand_v` are metres in the camera's frame, joints in
OpenPose's order; `general_info` holds tensors of PyTorch, the hand in the world with 16 quaternions wxyz
that leave no mean pose out. Pixels have their origin at the centre of the first one. The official lists
leave out a view in which less than half of the joints can be seen; one is left out here, though its files
exist.
"""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.hand.topology import WRIST
from poem_jax.miniatures.files import CUBE_OBJ, save, save_json
from poem_jax.miniatures.labels import joints_world, pose_world, quaternions
from poem_jax.miniatures.mano_stand_in import stand_in_hand
from poem_jax.miniatures.scene import PlantedFrame, Rig, draw_rig, index_origin, plant, png
from poem_jax.miniatures.torch_tensors import Tensor, dumps

VIEWS = ("north_east_color", "south_east_color", "north_west_color", "south_west_color")
"""By the number of the view."""
SIZE_WH = (848, 480)

Sample = tuple[str, int, int, int]
"""seq_id/timestamp, whose hand (0 gives, 1 receives), frame, view."""


class _Sequence(NamedTuple):
    place: str
    """seq_id/timestamp."""
    people: int
    part: str
    """Of the split by objects: train, val or test."""
    first_frame: int


_SEQUENCES = (
    _Sequence("A01001_0001_0000/2021-09-26-19-59-58", 1, "train", 53),
    _Sequence("A01001_0004_0001_0003/2021-10-09-16-11-33", 2, "train", 102),
    _Sequence("A02009_0002_0002/2021-09-27-18-20-04", 1, "val", 7),
    _Sequence("S10014_0003_0004/2021-10-02-10-45-12", 1, "test", 31),
)
_TEST_SUBJECTS = {"0004"}
_STEP = 4
"""Frames between those that are kept."""


def write(root: Path, *, frames: int = 2, seed: int = 0) -> list[PlantedFrame]:
    """Write a tiny OakInk below `root` and return what it shows: train, val, test.

    Args:
        root: the folder that holds `image`.
        frames: of the first training sequence; the other three have one each, the handover two hands.
        seed: of all chance.
    """
    image = Path(root) / "image"
    planted: dict[tuple[str, int, int], PlantedFrame] = {}
    parts: dict[str, str] = {}
    for number, sequence in enumerate(_SEQUENCES):
        rig = draw_rig((seed, 3, number), VIEWS, SIZE_WH)
        for step in range(frames if number == 0 else 1):
            fid = sequence.first_frame + _STEP * step
            for person in range(sequence.people):
                frame = _plant((seed, 3, number, step, person), rig, sequence, fid)
                # Both people of a handover stand in one picture; only the giver's hand is drawn.
                giver = planted.get((sequence.place, 0, fid), frame)
                planted[sequence.place, person, fid] = frame._replace(images=giver.images)
        parts[sequence.place] = sequence.part
    for frame_id, frame in planted.items():
        _write_frame(image, frame_id, frame)
    _write_lists(image, list(planted), parts)
    _write_packed(image, planted, parts)
    for name in sorted({place.split("_")[0] for place in parts}):
        save(image / "obj" / f"{name}.obj", CUBE_OBJ)
    return list(planted.values())


def _plant(seed: tuple[int, ...], rig: Rig, sequence: _Sequence, fid: int) -> PlantedFrame:
    hint = f"{sequence.place}/{seed[-1]}/{fid}"
    return plant(seed, rig, stand_in_hand(), key_hint=hint)


def _write_frame(image: Path, frame_id: tuple[str, int, int], frame: PlantedFrame) -> None:
    place, person, fid = frame_id
    for view, name in enumerate(VIEWS):
        if person == 0:
            save(image / "stream_release_v2" / place / f"{name}_{fid}.png", png(frame.images[view]))
        info = sample_name((place, person, fid, view))
        fields = _fields(frame, view)
        for folder in ("cam_intr", "hand_j", "hand_v", "obj_transf"):
            save(image / "anno" / folder / f"{info}.pkl", pickle.dumps(fields[folder], protocol=4))
        save(image / "anno" / "general_info" / f"{info}.pkl", dumps(_general_info(frame, view)))


def sample_name(sample: Sample) -> str:
    """Return the name of a sample's files."""
    return "__".join(map(str, sample)).replace("/", "__")


def _fields(frame: PlantedFrame, view: int) -> dict[str, Any]:
    return {
        "cam_extr": frame.T_cam_from_world[view].astype(np.float32),
        "cam_intr": index_origin(frame.K[view]).astype(np.float32),
        "hand_j": frame.joints_cam[view].astype(np.float32),
        "hand_v": frame.vertices_cam[view].astype(np.float32),
        "mano_pose": frame.pose_cam[view].astype(np.float32),
        "mano_shape": frame.shape.astype(np.float32),
        "obj_transf": (frame.T_cam_from_world[view] @ _object(frame)).astype(np.float32),
    }


def _object(frame: PlantedFrame) -> np.ndarray:
    """Return T_world_from_object: it lies in the hand."""
    T = np.eye(4)
    T[:3, 3] = joints_world(frame).mean(0)
    return T


def _general_info(frame: PlantedFrame, view: int) -> dict[str, Any]:
    return {
        "hand_anno": {
            "hand_tsl": Tensor(joints_world(frame)[WRIST]),
            "hand_shape": Tensor(frame.shape),
            "hand_pose": Tensor(quaternions(pose_world(frame))),
        },
        "cam_extr": Tensor(frame.T_cam_from_world[view]),
        "cam_intr": Tensor(index_origin(frame.K[view])),
        "obj_anno": Tensor(_object(frame)),
    }


def _write_lists(image: Path, frame_ids: list[tuple[str, int, int]], parts: dict[str, str]) -> None:
    samples: list[Sample] = [(*frame_id, view) for view in range(4) for frame_id in frame_ids]
    unseen = (*frame_ids[0], 3)
    official = [sample for sample in samples if sample != unseen]
    save_json(image / "anno" / "seq_all.json", samples)
    save_json(image / "anno" / "seq_status.json", {place: "approved" for place in parts})
    for folder in ("split0", "split0_ho"):
        _write_split(image / "anno", folder, official, lambda sample: "test" if sample[3] == 2 else "train")
    for folder, choose in (("split1", _part_by_subject), ("split2", lambda sample: parts[sample[0]])):
        _write_split(image / "anno", folder, official, choose)
        all_views: list[Sample] = [
            (*frame_id, view) for frame_id in sorted({sample[:3] for sample in official}) for view in range(4)
        ]
        _write_split(image / "anno_mv", folder, all_views, choose)


def _part_by_subject(sample: Sample) -> str:
    return "test" if _TEST_SUBJECTS & set(sample[0].split("/")[0].split("_")[2:]) else "train"


def _write_split(
    annotations: Path, folder: str, samples: list[Sample], choose: Callable[[Sample], str]
) -> None:
    """`seq_train.json` holds train and val; the lists of `split_train_val` tell them apart."""
    lists = {part: [s for s in samples if choose(s) == part] for part in ("train", "val", "test")}
    both = [s for s in samples if choose(s) != "test"]
    save_json(annotations / "split" / folder / "seq_train.json", both)
    save_json(annotations / "split" / folder / "seq_test.json", lists["test"])
    for part in ("train", "val"):
        name = f"example_split_{part}.json"
        save_json(annotations / "split_train_val" / folder / name, lists[part])


def _write_packed(
    image: Path, planted: dict[tuple[str, int, int], PlantedFrame], parts: dict[str, str]
) -> None:
    for (place, person, fid), frame in planted.items():
        for view in range(4):
            sample = (place, person, fid, view)
            for mode, part in (("object", parts[place]), ("subject", _part_by_subject(sample))):
                fields = {**_fields(frame, view), "sample_status": "approved"}
                for split in ("test",) if part == "test" else ("train+val", part):
                    path = image / "anno_packed_mv" / mode / split / f"{sample_name(sample)}.pkl"
                    save(path, pickle.dumps(fields, protocol=4))
