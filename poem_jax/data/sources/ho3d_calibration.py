"""The cameras of HO-3D's multi-view sequences: from calibration files, or from the labels themselves.

`trans_<i>.txt` maps a camera to a common frame (OpenCV axes, metres). Which camera is written in
`cam_orders.txt`, five digits o: the released POEM reads `trans_{o[d]}` for the sequence of digit d, while the
authors' own `vis_pcl_all_cameras.py` pairs `trans_i` with the sequence of digit o[i]. For orders that are
their own inverse both are the same. As every view is labelled with the same hand, the labels decide: the
release's reading is kept unless the hands of the views do not meet under it, and do under the other.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.data.frames import CorruptSampleError
from poem_jax.geometry.alignment import procrustes
from poem_jax.geometry.transforms import invert_rigid, rigid, transform_points
from poem_jax.typing import Array, Float

NUM_CAMERAS = 5
_MEET_M = 0.03
"""Labels of one hand that are further apart in the world than this do not meet."""
_LABELS_MEET_M = 0.01
_MAX_BYTES = 2**16

_log = logging.getLogger(__name__)
_warned: set[Path] = set()


class Calibration(NamedTuple):
    """Five cameras of one recording."""

    folder: Path
    orders: tuple[int, ...]
    T_common_from_file: Float[Array, "file 4 4"]
    """Of `trans_0.txt` to `trans_4.txt`."""

    @classmethod
    def find(cls, folders: Sequence[Path], main: str) -> "Calibration | None":
        """Return the calibration of a sequence without its digit, or None where there is none.

        Args:
            folders: Each a `calibration`, as the set has it; the first that has the sequence is taken.
            main: The sequence.

        Raises:
            FileNotFoundError: A file of it is missing.
            ValueError: A file of it is damaged.
        """
        places = (folder / main / "calibration" for folder in folders)
        folder = next((place for place in places if place.is_dir()), None)
        if folder is None:
            return None
        orders = _numbers(folder / "cam_orders.txt", NUM_CAMERAS)
        if sorted(orders) != list(range(NUM_CAMERAS)):
            raise ValueError(
                f"{folder / 'cam_orders.txt'} must hold each of 0 to 4 once; got {orders.tolist()}"
            )
        files = [_numbers(folder / f"trans_{i}.txt", 16).reshape(4, 4) for i in range(NUM_CAMERAS)]
        return cls(folder, tuple(int(order) for order in orders), np.stack(files))

    def extrinsics(
        self, digits: list[int], joints_cam: Float[Array, "view 21 3"], key: str
    ) -> Float[Array, "view 4 4"]:
        """Return `T_cam_from_world` of the cameras with these digits.

        Args:
            digits: Of the sequences, one for each view.
            joints_cam: The hand as labelled in each view, metres.
            key: Of the sample, for messages.

        Raises:
            CorruptSampleError: The hands do not meet under either reading.
        """
        release = self.T_common_from_file[[self.orders[digit] for digit in digits]]
        apart = _distance(release, joints_cam)
        if apart <= _MEET_M:
            return invert_rigid(release)
        inverse = self.T_common_from_file[[self.orders.index(digit) for digit in digits]]
        apart_inverse = _distance(inverse, joints_cam)
        if apart_inverse > _MEET_M:
            raise CorruptSampleError(
                self.folder,
                key,
                f"the hands of the views lie {apart:.3g} m apart in the world (and {apart_inverse:.3g} m "
                f"with cam_orders.txt read the other way); expected at most {_MEET_M}. The calibration is of "
                "another recording, or a label is wrong",
            )
        if self.folder not in _warned:
            _warned.add(self.folder)
            _log.warning(
                "%s: cam_orders.txt is read as the data set's authors do, not as the released POEM does, "
                "whose reading leaves the hands of the views %.3g m apart",
                *(self.folder, apart),
            )
        return invert_rigid(inverse)


def align_labels(joints_cam: Float[Array, "view 21 3"], path: Path, key: str) -> Float[Array, "view 4 4"]:
    """Return `T_cam_from_world`, the world being the first camera, by which all views see the first's hand.

    Raises:
        CorruptSampleError: The labels are not those of one hand.
    """
    T = np.stack([np.eye(4), *(_rigid_between(joints_cam[0], joints) for joints in joints_cam[1:])])
    apart = np.linalg.norm(transform_points(T, joints_cam[:1]) - joints_cam, axis=-1).max()
    if not apart <= _LABELS_MEET_M:
        raise CorruptSampleError(path, key, f"the views' labels are not one rigid hand: {apart:.3g} m apart")
    return T


def _rigid_between(source: Float[Array, "21 3"], target: Float[Array, "21 3"]) -> Float[Array, "4 4"]:
    found = procrustes(source, target, with_scale=False)
    return rigid(found.R, found.t)


def _distance(T_common_from_cam: Float[Array, "view 4 4"], joints_cam: Float[Array, "view 21 3"]) -> float:
    """Return how far the joints lie from where the first view has them."""
    joints = transform_points(T_common_from_cam, joints_cam)
    return float(np.linalg.norm(joints - joints[:1], axis=-1).max())


def _numbers(path: Path, count: int) -> Float[Array, " count"]:
    if not path.is_file():
        raise FileNotFoundError(
            f"a calibration file is missing: expected {path}; fetch HO-3D's calibration again"
        )
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError("it is too large")
        numbers = np.array(path.read_text(encoding="utf-8").split(), np.float64)
    except ValueError as error:
        raise ValueError(f"{path} must hold {count} numbers; {error}") from error
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"{path} must hold {count} finite numbers; got {len(numbers)}")
    return numbers
