"""Run the rows of a table that can run here; name for the others what is missing.

Sets and models are opened once for all rows that share them, so that each model compiles once a number of
views.
"""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TypeVar

from poem_jax.data.frames import FrameSource
from poem_jax.data.sources.ho3d import HO3D
from poem_jax.data.view_sampling import cameras_in_words
from poem_jax.evaluation.dataset import SetScores, SetSettings, ViewAnswer, score_set
from poem_jax.evaluation.ho3d_submission import Ho3dSubmission
from poem_jax.evaluation.keypoint_fitting import KeypointFitting, read_keypoints
from poem_jax.evaluation.systems import Network, System
from poem_jax.hand.mano_file import load as load_hand
from poem_jax.hand.template import default_hand
from poem_jax.tables.places import Places
from poem_jax.tables.result import Line, RunSettings
from poem_jax.tables.row import Checkpoint, Fitting, Quoted, Row, Shipped
from poem_jax.tables.same_system import is_of_preset
from poem_jax.tables.splits import Opened, OwnCapture, Split
from poem_jax.weights.store import SHIPPED, load, read_config

_Made = TypeVar("_Made")

_JOINTS_ALONE = (
    "joints alone are scored, as predicted: the labels have no vertices of the hand that the system finds"
)


def run_rows(
    table: str, rows: Sequence[Row], places: Places, settings: RunSettings
) -> tuple[tuple[Line, ...], tuple[str, ...]]:
    """Return the lines of a table, and the files that were written besides.

    A row that cannot be scored, because its data are damaged, say, is listed with the reason like one whose
    data are missing, and the others run.
    """
    opened = _Opened(places)
    files: list[str] = []
    lines = tuple(_line(table, row, opened, settings, files) for row in rows)
    return lines, tuple(files)


class _Opened:
    """Sets and systems, each opened when the first row asks for it; errors are kept, too."""

    def __init__(self, places: Places) -> None:
        self.places = places
        self.data = cache(self._data)
        self.system = cache(self._system)

    def _data(self, data: Split | OwnCapture) -> Opened | str:
        return _or_message(lambda: data.open(self.places))

    def _system(self, system: Checkpoint | Shipped | Fitting) -> System | str:
        match system:
            case Checkpoint():
                return _or_message(lambda: self._network(system))
            case Shipped():
                return Network(*load(SHIPPED))
            case Fitting():
                return _or_message(lambda: self._fitting(system))

    def no_weights(self, system: Checkpoint | Shipped | Fitting) -> str | None:
        """Say how a checkpoint is made that is not there; nothing is loaded."""
        if not isinstance(system, Checkpoint) or (self.places.checkpoints / system.name).is_dir():
            return None
        ways = "; or ".join(system.ways(self.places))
        return f"no checkpoint in {self.places.checkpoints / system.name}: {ways}"

    def _network(self, checkpoint: Checkpoint) -> Network:
        folder = self.places.checkpoints / checkpoint.name
        config = read_config(folder)
        if not is_of_preset(config, checkpoint.preset):
            raise ValueError(
                f"{folder} holds another system, a {type(config).__name__}; expected {checkpoint.preset}: "
                f"{'; or '.join(checkpoint.ways(self.places))}"
            )
        return Network(*load(folder))

    def _fitting(self, fitting: Fitting) -> KeypointFitting:
        hand = load_hand(self.places.mano) if self.places.mano.is_file() else default_hand()
        file = self.keypoints(fitting)
        keypoints = None if file is None else read_keypoints(file)
        return KeypointFitting(hand, keypoints, solver=fitting.solver)

    def keypoints(self, fitting: Fitting) -> Path | None:
        """Return the file of key points, if it is there."""
        file = None if fitting.keypoints is None else self.places.keypoints(fitting.keypoints)
        return file if file is not None and file.is_file() else None


def _or_message(make: Callable[[], _Made]) -> _Made | str:
    try:
        return make()
    except (OSError, ValueError) as error:
        return str(error)


def _line(table: str, row: Row, opened: _Opened, settings: RunSettings, files: list[str]) -> Line:
    """Run one row."""
    line = Line(
        group=row.data.title,
        label=row.label,
        columns=row.columns,
        paper=row.paper,
        number=row.number,
        num_views=row.num_views,
        series=f"{row.data.title}, {row.system.name}" if isinstance(row.system, Checkpoint) else "",
        against=row.against,
        notes=(row.note,) if row.note else (),
    )
    if isinstance(row.system, Quoted):
        return line._replace(notes=(*line.notes, "the paper's number"))
    line = line._replace(what=_how(row, opened))
    data, without = opened.data(row.data), opened.no_weights(row.system)
    if isinstance(data, str) or without is not None:
        return line._replace(absent=tuple(one for one in (data, without) if isinstance(one, str)))
    system = opened.system(row.system)
    if isinstance(system, str):
        return line._replace(absent=(system,))
    hands = Ho3dSubmission(data.source.num_images) if row.official and isinstance(data.source, HO3D) else None
    try:
        scores = score_set(system, data.source, _settings(row, settings), _listener(hands, data.source))
    except ValueError as error:
        return line._replace(absent=(f"could not be scored: {error}",))
    if isinstance(system, KeypointFitting) and system.unknown_keys is not None:
        return line._replace(absent=(f"could not be scored: {system.unknown_keys}",))
    notes = [*line.notes, *notes_of(scores)]
    if hands is not None:
        notes.append(_submit(hands, Path(settings.out) / f"{table}_submission.zip", files))
    return line._replace(
        ours=scores.means if scores.keys else None,
        spread=scores.standard_errors if scores.keys else {},
        samples=len(scores.keys),
        what={
            **line.what,
            "data": data.where,
            "protocol": scores.protocol,
            "root": root_in_words(scores),
        },
        notes=tuple(notes),
    )


def _settings(row: Row, settings: RunSettings) -> SetSettings:
    return SetSettings(
        cameras=row.cameras,
        protocol=row.protocol,
        given_root=row.given_root,
        each_view=row.official,
        samples=settings.samples,
        batch_size=settings.batch_size,
        seed=settings.seed,
        change=row.change,
        progress=settings.progress,
    )


def _how(row: Row, opened: _Opened) -> dict[str, str]:
    """Say how a row is scored, whether it can be or not."""
    cameras = cameras_in_words(row.cameras) + (", shuffled" if row.change is not None else "")
    root = "the true one" if row.given_root else "the system's own"
    return {
        "system": _system_in_words(row, opened),
        "data": row.data.title,
        "cameras": cameras,
        "protocol": row.protocol,
        "root": root,
    }


def _system_in_words(row: Row, opened: _Opened) -> str:
    match row.system:
        case Checkpoint(name):
            return str(opened.places.checkpoints / name)
        case Shipped():
            return "the shipped weights"
        case Fitting() as fitting:
            file = opened.keypoints(fitting)
            points = "our detector" if file is None else str(file)
            return f"{fitting.solver.value} on key points of {points}"
        case _:
            return ""


def root_in_words(scores: SetScores) -> str:
    """Say whose root the system worked about, sample by sample."""
    given, of = scores.num_roots_given, scores.num_samples
    if given == 0:
        return "the system's own"
    return (
        "the true one" if given == of else f"the true one in {given} of {of} samples, else the system's own"
    )


def notes_of(scores: SetScores) -> list[str]:
    """Say what a reader of the numbers must know of how they came about."""
    notes = [_JOINTS_ALONE] if scores.joints_alone else []
    if scores.num_cut:
        notes.append(
            f"of {scores.num_cut} samples the system saw fewer views than these: it takes no more at a time"
        )
    if scores.unsolved:
        notes.append(f"{scores.unsolved} samples, in which no hand was found, are in no mean")
    if scores.left_out:
        notes.append(f"{len(scores.left_out)} samples could not be used; the first: {scores.left_out[0]}")
    return notes


def _listener(hands: Ho3dSubmission | None, source: FrameSource) -> Callable[[ViewAnswer], None] | None:
    """Return what puts every hand in its place of a submission."""
    if hands is None or not isinstance(source, HO3D):
        return None
    return lambda hand: hands.add(source.rows(hand.sample)[hand.view], hand.joints_cam, hand.vertices_cam)


def _submit(hands: Ho3dSubmission, file: Path, files: list[str]) -> str:
    """Write a submission that is whole; return what became of it."""
    try:
        hands.write(file)
    except ValueError as error:
        return f"no submission is written: {error}"
    files.append(str(file))
    return f"submission for the official evaluation: {file}"
