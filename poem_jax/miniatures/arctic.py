"""A tiny ARCTIC: layout of `docs/data/data_doc.md` and the toolkit of github.com/zc-alexfan/arctic.

    arctic_data/data/images/<subject>/<sequence>/<view 0..8>/%05d.jpg
    arctic_data/data/raw_seqs/<subject>/<sequence>.{mano, object, smplx, egocam.dist}.npy
    arctic_data/data/meta/misc.json, meta/{object, subject}_vtemplates/...
    arctic_data/data/splits_json/protocol_{p1, p2}.json

View 0 is worn on the head, 1 to 8 stand. `world2cam` and `intris_mat` list the eight that stand,
`image_size` all nine. MANO's parameters are those of the world, axis-angle less the mean pose, metres, a
hand that is not centred. Image i belongs to entry i - ioi_offset of the parameters; images 10 to N - 11
are used, N being the number of entries (`split.py`). Joints are not stored: the toolkit takes MANO's
skeleton and the tips of smplx. Pixels have their origin at the centre of the first one. Left out are
`cropped_images` and `splits`, which the toolkit computes from the rest.
"""

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from poem_jax.hand.topology import NUM_SHAPES, WRIST
from poem_jax.miniatures.enlarged import enlarged
from poem_jax.miniatures.files import CUBE_OBJ, save, save_json, save_npy
from poem_jax.miniatures.labels import joints_world, pose_world, with_smplx_tips
from poem_jax.miniatures.mano_stand_in import stand_in_components, stand_in_hand
from poem_jax.miniatures.scene import PlantedFrame, Rig, draw_rig, index_origin, jpeg, plant
from poem_jax.typing import Array, Float

VIEWS = ("1", "2", "3", "4", "5", "6", "7", "8")
"""Those that stand."""
SIZE_WH, UPRIGHT_WH = (2800, 2000), (2000, 2800)
"""Views 2 and 7 stand upright."""
_FACTOR = 5
"""Pictures are drawn at a fifth of their size."""
_UNUSED = 10
"""Images at either end of a sequence."""
_QUALITY = 75
_SUBJECTS = {f"s{i:02d}": "female" if i in (1, 2, 5, 8, 9) else "male" for i in range(1, 11)}


class _Sequence(NamedTuple):
    subject: str
    name: str
    split: str
    ioi_offset: int


_SEQUENCES = (_Sequence("s01", "box_grab_01", "train", 3), _Sequence("s05", "box_use_01", "val", 1))
_HIDDEN = _Sequence("s03", "box_grab_01", "test", 2)
"""Its labels are kept back by the authors."""


def write(root: Path, *, frames: int = 2, seed: int = 0) -> list[PlantedFrame]:
    """Write a tiny ARCTIC below `root` and return the right hands that it shows: train, val.

    Args:
        root: the folder that holds `arctic_data`.
        frames: in train; val has one.
        seed: of all chance.
    """
    data = Path(root) / "arctic_data" / "data"
    planted: list[PlantedFrame] = []
    rigs = {}
    for order, sequence in enumerate(_SEQUENCES):
        rig = large_rig((seed, 6, order))
        shape = np.random.default_rng((seed, 7, order)).standard_normal(NUM_SHAPES)
        shown = [
            plant_large(
                (seed, 6, order, i),
                rig,
                f"{sequence.subject}/{sequence.name}/{_UNUSED + i:05d}",
                shape=shape,
            )
            for i in range(frames if sequence.split == "train" else 1)
        ]
        shown = [with_smplx_tips(frame) for frame in shown]
        _write_images(data / "images" / sequence.subject / sequence.name, shown)
        _write_parameters(data / "raw_seqs" / sequence.subject, sequence, shown)
        rigs[sequence.subject] = shown[0]
        planted += shown
    hidden = data / "images" / _HIDDEN.subject / _HIDDEN.name
    for view in VIEWS:
        save(hidden / view / f"{_UNUSED:05d}.jpg", _black())
    _write_meta(data / "meta", rigs)
    lists = {s.split: [f"{s.subject}/{s.name}"] for s in (*_SEQUENCES, _HIDDEN)}
    for protocol in ("p1", "p2"):
        save_json(data / "splits_json" / f"protocol_{protocol}.json", lists)
    return planted


def large_rig(seed: tuple[int, ...]) -> Rig:
    """Draw the eight cameras at a fifth of their size; `plant_large` gives frames of full size."""
    sizes = [UPRIGHT_WH if view in ("2", "7") else SIZE_WH for view in VIEWS]
    return draw_rig(seed, VIEWS, [(w // _FACTOR, h // _FACTOR) for w, h in sizes])


def plant_large(
    seed: tuple[int, ...],
    rig: Rig,
    key_hint: str,
    *,
    side: str = "right",
    shape: Float[Array, "10"] | None = None,
) -> PlantedFrame:
    """Plant a hand in pictures of full size; `shape` None draws its shape."""
    return enlarged(plant(seed, rig, stand_in_hand(side), key_hint=key_hint, shape=shape), _FACTOR)


def _write_images(folder: Path, shown: list[PlantedFrame]) -> None:
    """Write what the views see, and black pictures where nothing may be read: before, after, and view 0."""
    for step, frame in enumerate(shown):
        for view, name in enumerate(VIEWS):
            save(folder / name / f"{_UNUSED + step:05d}.jpg", jpeg(frame.images[view], _QUALITY))
    save(folder / "0" / f"{_UNUSED:05d}.jpg", _black())
    for number in (_UNUSED - 1, _UNUSED + len(shown)):
        save(folder / "1" / f"{number:05d}.jpg", _black())


@cache
def _black() -> bytes:
    """Return a black picture; those at a sequence's ends can be so."""
    return jpeg(np.zeros((SIZE_WH[1], SIZE_WH[0], 3), np.uint8), _QUALITY)


def _write_parameters(folder: Path, sequence: _Sequence, shown: list[PlantedFrame]) -> None:
    count = 2 * _UNUSED + len(shown)
    rng = np.random.default_rng((count, sequence.ioi_offset))
    mean = stand_in_components().mean.astype(np.float64)
    right = _moving(count, rng, shown[0].shape)
    for step, frame in enumerate(shown):
        entry = _UNUSED + step - sequence.ioi_offset
        pose = pose_world(frame)
        right["rot"][entry] = pose[WRIST]
        right["pose"][entry] = pose[1:].reshape(-1) - mean
        right["trans"][entry] = joints_world(frame)[WRIST] - _resting_wrist(frame)
    left = _moving(count, rng, shown[0].shape)
    base = folder / sequence.name
    save_npy(base.with_name(f"{base.name}.mano.npy"), {"right": right, "left": left})
    things = np.concatenate([rng.uniform(0, 1, (count, 4)), rng.uniform(-100, 100, (count, 3))], axis=1)
    save_npy(base.with_name(f"{base.name}.object.npy"), things)
    save_npy(base.with_name(f"{base.name}.smplx.npy"), _body(count, rng))
    save_npy(base.with_name(f"{base.name}.egocam.dist.npy"), _worn_camera(count, rng))


def _moving(
    count: int, rng: np.random.Generator, shape: Float[Array, "10"]
) -> dict[str, Float[Array, "..."]]:
    """Return the parameters of a hand in all entries, another pose in each."""
    return {
        "rot": rng.uniform(-1, 1, (count, 3)),
        "pose": rng.uniform(-0.3, 0.3, (count, 45)),
        "trans": rng.uniform(-0.1, 0.1, (count, 3)),
        "shape": shape.copy(),
        "fitting_err": rng.uniform(0, 2, count),
    }


def _resting_wrist(frame: PlantedFrame) -> Float[Array, "3"]:
    """Return where the layer has the wrist about which it turns the hand."""
    hand = stand_in_hand()
    return hand.J_regressor.astype(np.float64)[WRIST] @ (hand.v_template + hand.shapedirs @ frame.shape)


def _body(count: int, rng: np.random.Generator) -> dict[str, Float[Array, "..."]]:
    widths = {"transl": 3, "global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}
    widths |= {"left_hand_pose": 45, "right_hand_pose": 45}
    return {name: rng.uniform(-0.3, 0.3, (count, width)) for name, width in widths.items()}


def _worn_camera(count: int, rng: np.random.Generator) -> dict[str, Any]:
    return {
        "R_k_cam_np": np.tile(np.eye(3), (count, 1, 1)),
        "T_k_cam_np": rng.uniform(-0.1, 0.1, (count, 3, 1)),
        "intrinsics": np.array([[1800.0, 0, 1399.5], [0, 1800.0, 999.5], [0, 0, 1]]),
        "ego_markers.ref": rng.uniform(-0.1, 0.1, (4, 3)),
        "ego_markers.label": ["EGO1", "EGO2", "EGO3", "EGO4"],
        "R0": np.eye(3),
        "T0": np.zeros((3, 1)),
        "dist8": np.array([0.1, -0.05, 0, 0, 0.01, 0, 0, 0]),
    }


def _write_meta(folder: Path, shown: dict[str, PlantedFrame]) -> None:
    offsets = {s.subject: s.ioi_offset for s in (*_SEQUENCES, _HIDDEN)}
    misc = {}
    for subject, gender in _SUBJECTS.items():
        frame = shown.get(subject, next(iter(shown.values())))
        misc[subject] = {
            "gender": gender,
            "ioi_offset": offsets.get(subject, 4),
            "image_size": [list(SIZE_WH), *frame.size_wh.tolist()],
            "world2cam": frame.T_cam_from_world.tolist(),
            "intris_mat": index_origin(frame.K).tolist(),
        }
        save(folder / "subject_vtemplates" / f"{subject}.obj", CUBE_OBJ)
    save_json(folder / "misc.json", misc)
    thing = folder / "object_vtemplates" / "box"
    for name in ("mesh", "top", "bottom", "mesh_tex"):
        save(thing / f"{name}.obj", CUBE_OBJ)
    save_json(thing / "parts.json", [1, 0, 1, 0, 1, 0, 1, 0])
    save_json(thing / "object_params.json", {"bbox_top": [[0, 0, 0]], "bbox_bottom": [[0, 0, 50]]})
    for name in ("top", "bottom"):
        save_json(thing / f"{name}_keypoints_300.json", {"keypoints": [[0, 0, 0]]})
