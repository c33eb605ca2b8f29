"""Score a system on a data set: crops as at test time, a rule for the cameras, a protocol, sample by sample.

All metrics of a protocol are means over samples, so that each sample is evaluated by itself and memory does
not grow with the set; `SetScores.means` are the official numbers, and the spread is there besides. The world
is the first chosen camera, whose own label is the truth, as in training and in both releases.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from tqdm import tqdm

from poem_jax.batch import MultiViewBatch
from poem_jax.data.augmentation import augment
from poem_jax.data.batching import collate, pad_batch
from poem_jax.data.frames import CorruptSampleError, FrameSource
from poem_jax.data.view_sampling import AllViews, ViewSampling
from poem_jax.evaluation.metrics import evaluate, evaluate_joints
from poem_jax.evaluation.protocols import find_protocol
from poem_jax.evaluation.systems import Answer, Seen, System
from poem_jax.geometry.transforms import invert_rigid, transform_points
from poem_jax.hand.model import HandModel, joints_from_vertices
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.io.reading_ahead import read_ahead
from poem_jax.typing import Float, PRNGKeyArray

SAME_HAND_M = 0.015
"""Labelled joints lie this near, on average, to those that a hand's regressor reads off its own vertices."""

_log = logging.getLogger(__name__)


@runtime_checkable
class Change(Protocol):
    """What is done to a batch before it is given to the system: one of `evaluation.robustness`."""

    def __call__(self, batch: MultiViewBatch, *, key: PRNGKeyArray) -> MultiViewBatch:
        """Change the cameras; the hand in the world stays."""
        ...


@dataclass(frozen=True)
class SetSettings:
    """How a set is scored."""

    cameras: ViewSampling = AllViews()
    """Which views of a frame, and in which order."""
    protocol: str = "poem"
    given_root: bool = False
    """The true root is given wherever the system takes one; else to samples of one view alone."""
    each_view: bool = False
    """Score the hand in every view's camera against that view's label, as HO-3D's official evaluation, which
    counts images; else in the first one's."""
    samples: int | None = None
    """So many, evenly spread over the set; None = all."""
    batch_size: int = 8
    seed: int = 0
    """Of the cameras and of `change`."""
    change: Change | None = None
    progress: bool = True

    def __post_init__(self) -> None:
        find_protocol(self.protocol)
        if self.batch_size < 1 or (self.samples is not None and self.samples < 1):
            raise ValueError(
                f"`samples` and `batch_size` must be at least 1; got {self.samples}, {self.batch_size}"
            )


class SetScores(NamedTuple):
    """Every metric of every sample that was scored."""

    keys: tuple[str, ...]
    """Of the samples, or with `each_view` of their images: `KEY:VIEW`."""
    rows: dict[str, Float[np.ndarray, " sample"]]
    """By metric, as `evaluate` names them."""
    protocol: str
    """The one that was used: without vertices to compare, that of the joints given."""
    joints_alone: bool
    """Labels have no vertices, or those of another hand than the system's."""
    unsolved: int
    """Samples, or with `each_view` their images, in which the system found no hand; they are in no mean."""
    left_out: tuple[str, ...]
    """Samples that could not be used, one line each."""
    num_samples: int
    """That the system looked at."""
    num_roots_given: int
    """Samples of which it was given the true root."""
    num_cut: int
    """Samples of which it saw fewer views than the rule would have drawn, had it had room for them."""

    @property
    def means(self) -> dict[str, float]:
        """Return the protocol's numbers."""
        return {name: float(values.mean()) for name, values in self.rows.items()}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Return the standard error of each mean, over samples; NaN for a single one."""
        return {name: standard_error(values) for name, values in self.rows.items()}


class ViewAnswer(NamedTuple):
    """A hand in the frame of one camera, metres, and the truth there; what a listener is told."""

    sample: int
    """Index in the source."""
    view: int
    """Of its frame."""
    joints_cam: Float[np.ndarray, "21 3"]
    vertices_cam: Float[np.ndarray, "778 3"]


class _Read(NamedTuple):
    index: int
    sample: MultiViewBatch
    seen: Seen
    knows_root: bool
    is_cut: bool


def standard_error(values: Float[np.ndarray, " sample"]) -> float:
    """Return the spread of values by the root of their number: how far their mean is to be trusted."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def score_set(
    system: System,
    source: FrameSource,
    settings: SetSettings = SetSettings(),
    listen: Callable[[ViewAnswer], None] | None = None,
) -> SetScores:
    """Score a system on a set.

    Args:
        system: a `Network`, key-point fitting, or another.
        source: frames, in any number of views.
        settings: cameras, protocol, sizes.
        listen: is told every hand that was found, and counts.

    Raises:
        ValueError: no sample can be used, or a prediction is not finite.
    """
    most = min(n for n in (source.max_views, system.most_views) if n is not None)
    left_out: list[str] = []
    keys: list[str] = []
    rows: list[dict[str, float]] = []
    unsolved, num_roots_given, num_cut, num_samples = 0, 0, 0, 0
    compares_vertices = None
    protocol = settings.protocol
    count = len(source) if settings.samples is None else min(settings.samples, len(source))
    with tqdm(total=count, unit="sample", desc=source.name, disable=not settings.progress) as bar:
        for number, (batch, read) in enumerate(_batches(system, source, settings, count, most, left_out)):
            if compares_vertices is None:
                compares_vertices = is_of_hand(system.hand, read[0].sample)
                protocol = settings.protocol if compares_vertices else _of_joints(settings.protocol)
            if settings.change is not None:
                key = jax.random.fold_in(jax.random.key(settings.seed), number)
                batch = settings.change(batch, key=key)
            answer = system(batch, [one.seen for one in read])
            for place, one in enumerate(read):
                scored_in = one.seen.views if settings.each_view else one.seen.views[:1]
                for view in scored_in:
                    hand = _in_view(answer, place, one, int(view))
                    if answer.valid[place]:
                        if listen is not None:
                            listen(hand)
                        rows.append(_evaluated(hand, one, protocol, compares_vertices, system.hand))
                        keys.append(_key(one, int(view), settings.each_view))
                unsolved += 0 if answer.valid[place] else len(scored_in)
                num_roots_given += one.knows_root
                num_cut += one.is_cut
                num_samples += 1
            bar.update(len(read))
    for line in left_out:
        _log.warning("left out: %s", line)
    if compares_vertices is None:
        raise ValueError(f"none of {count} samples of {source.name} can be used: {'; '.join(left_out[:3])}")
    by_metric = {name: np.array([row[name] for row in rows]) for name in rows[0]} if rows else {}
    return SetScores(
        tuple(keys),
        by_metric,
        protocol,
        not compares_vertices,
        unsolved,
        tuple(left_out),
        num_samples,
        num_roots_given,
        num_cut,
    )


def is_of_hand(hand: HandModel, sample: MultiViewBatch) -> bool:
    """Tell whether a sample's vertices are those of a hand: its regressor finds the labelled joints in them.

    Two hands of MANO's schema, MANO's and the package's, have vertices of the same number at other places.
    """
    vertices = np.asarray(sample.vertices_world, np.float64)
    if not np.isfinite(vertices).all():
        return False
    double = hand._replace(J_regressor=np.asarray(hand.J_regressor, np.float64))
    apart = np.linalg.norm(joints_from_vertices(double, vertices) - sample.joints_world, axis=-1)
    return bool(apart.mean() < SAME_HAND_M)


def _of_joints(protocol: str) -> str:
    return "poem" if find_protocol(protocol).regresses_joints else protocol


def _batches(
    system: System,
    source: FrameSource,
    settings: SetSettings,
    count: int,
    most: int,
    left_out: list[str],
) -> Iterator[tuple[MultiViewBatch, list[_Read]]]:
    """Yield padded batches of one shape; samples that cannot be used are named in `left_out`."""

    def read(index: int) -> _Read | str:
        try:
            return _read(system, source, settings, index, most)
        except CorruptSampleError as error:
            return str(error)

    indices = np.linspace(0, len(source) - 1, count).round().astype(int).tolist()
    size = 1 if system.one_at_a_time else settings.batch_size
    group: list[_Read] = []
    for _, one in read_ahead(indices, read, depth=2 * size):
        if isinstance(one, str):
            left_out.append(one)
            continue
        group.append(one)
        if len(group) == size:
            yield _batch(group, size, most), group
            group = []
    if group:
        yield _batch(group, size, most), group


def _read(system: System, source: FrameSource, settings: SetSettings, index: int, most: int) -> _Read | str:
    """Read a sample with nothing augmented, its views drawn from seed and index; a line where it is of no
    use to the system."""
    frame = source[index]
    views, wanted = (
        settings.cameras.draw(len(frame.images), np.random.default_rng((settings.seed, index)), limit)
        for limit in (most, None)
    )
    knows_root = system.takes_root and (settings.given_root or len(views) == 1)
    if len(views) < system.least_views and not knows_root:
        return f"{source.name} {frame.key}: {len(views)} view of a hand, and the system needs two"
    # Nothing is left to chance; augmenting draws all the same.
    sample = augment(frame, views, system.recipe, system.image_hw, np.random.default_rng(0))
    root = sample.joints_world[ROOT_JOINT] if knows_root else np.full(3, np.nan, np.float32)
    sample = sample._replace(pose=None, shape=None, root_world=root)
    return _Read(index, sample, Seen(frame, views), knows_root, len(views) < len(wanted))


def _batch(group: Sequence[_Read], size: int, most: int) -> MultiViewBatch:
    return pad_batch(collate([one.sample for one in group], most), size)


def _in_view(answer: Answer, place: int, one: _Read, view: int) -> ViewAnswer:
    """Return a sample's hand in the frame of one of its cameras, float64."""
    T = one.seen.frame.T_cam_from_world.astype(np.float64)
    T_view_from_first = T[view] @ invert_rigid(T[int(one.seen.views[0])])
    joints, vertices = (
        transform_points(T_view_from_first, np.asarray(points[place], np.float64))
        for points in (answer.joints_world, answer.vertices_world)
    )
    return ViewAnswer(one.index, view, joints, vertices)


def _evaluated(
    found: ViewAnswer, one: _Read, protocol: str, compares_vertices: bool, hand: HandModel
) -> dict[str, float]:
    frame = one.seen.frame
    joints, truth = found.joints_cam[None], frame.joints_cam[found.view][None]
    if not compares_vertices:
        return evaluate_joints(joints, truth, protocol=protocol)
    vertices, mesh = found.vertices_cam[None], frame.vertices_cam[found.view][None]
    return evaluate(joints, truth, vertices, mesh, protocol=protocol, hand=hand)


def _key(one: _Read, view: int, each_view: bool) -> str:
    return f"{one.seen.frame.key}:{one.seen.frame.view_names[view]}" if each_view else one.seen.frame.key
