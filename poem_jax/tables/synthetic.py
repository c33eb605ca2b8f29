"""The synthetic table: the paper's systems trained alike, on one fixed rig, and tested on three.

No number of the paper's is of these captures; what can be compared is the order of the systems. A system
that stays above the mean hand with true root and rotation has not been trained far enough, and has no rank.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from poem_jax.batch import MultiViewBatch
from poem_jax.evaluation.captures import (
    PROTOCOL,
    CaptureScores,
    mean_hands,
    mean_hands_rotated,
    primary_cameras,
    score_captures,
    score_hands,
    truth_of,
)
from poem_jax.evaluation.dataset import Change, standard_error
from poem_jax.evaluation.first_stage_fitting import FirstStageFitting
from poem_jax.evaluation.robustness import shuffle_cameras
from poem_jax.evaluation.systems import Network, System
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.synthetic.table_rigs import CORNERS, FRONT, RING, TEST_FRAMES, TableRig, captures_of
from poem_jax.tables.kept_scores import (
    Question,
    ScoresFile,
    checksum_of,
    checksum_of_first_stage,
    marks_of,
)
from poem_jax.tables.places import Places
from poem_jax.tables.result import Line, RunSettings, TableResult
from poem_jax.tables.row import AT_50_MM
from poem_jax.tables.synthetic_models import TABLE_MODELS
from poem_jax.tables.training_summary import Training, training_of
from poem_jax.typing import Float
from poem_jax.weights.store import SHIPPED, load

SEEDS = (0, 1)
"""With which every system is trained."""
FOLDER = "synthetic_table"
"""Below the folder of checkpoints: one for each system and seed, `v2-0`."""
KEPT = "synthetic_scores"
"""Beside the table: what each model came to, a file for each system and seed, and one of the fit."""
FITTED = "poem-fit.npz"
CAPTURES = SyntheticConfig()
"""The benchmark's, with the rigs' cameras in place of its own."""
ERROR = "mpvpe_mm"
"""What systems are ranked by, as the paper's are here."""
NOT_FAR_ENOUGH = "not trained far enough: above the mean hand with true root and rotation; not ranked"


@dataclass(frozen=True)
class Trained:
    """A system of the table, and what the paper has for it: MPVPE on DexYCB-Mv, 8 cameras."""

    name: str
    """Of its experiment, `synthetic_table:NAME`."""
    label: str
    paper_mm: float | None = None
    note: str = ""

    def folder(self, places: Places, seed: int) -> Path:
        """Return where its model is looked for."""
        return places.checkpoints / FOLDER / f"{self.name}-{seed}"

    def run(self, places: Places, seed: int) -> Path:
        """Return where it is trained."""
        return places.runs / f"{FOLDER}_{self.name}-{seed}"

    def missing(self, places: Places, seed: int) -> str | None:
        """Say how the model is made, if it is not there."""
        folder = self.folder(places, seed)
        if folder.is_dir():
            return None
        command = (
            f"poem train synthetic_table:{self.name} --train.seed {seed} --train.out {self.run(places, seed)}"
        )
        return f"no checkpoint in {folder}: {command}; then the same with --export {folder}"


_ON_OAKINK = "the paper has it on OakInk-Mv alone, MPVPE {} mm beside 6.20 of POEM v1"
TRAINED = (
    Trained("v2", "POEM v2", 6.80),
    Trained(
        "v2-apart",
        "POEM v2, query vectors drawn apart",
        note="each for itself; those of all others that have any begin as sines of the template, alike where "
        "queries are neighbours",
    ),
    Trained(
        "v2-row-major",
        "POEM v2, row-major fusion",
        note="fuses views as the release does, which mixes views, channels and points; not in the paper",
    ),
    Trained("v1", "POEM v1", 6.13),
    Trained("v1-1stage", "v1, 1stage", 9.42),
    Trained("v1-wo-proj", "v1, w/o-proj", 6.57),
    Trained("v1-wo-pt", "v1, w/o-pt", 7.63),
    Trained("v1-g-emb", "v1, G-emb", note=_ON_OAKINK.format(6.25)),
    Trained("v1-gv-emb", "v1, G&V-emb", note=_ON_OAKINK.format(6.23)),
    Trained("pe-meshtr", "PE-MeshTR", 7.41),
    Trained("ftl-meshtr", "FTL-MeshTR", 8.75),
    Trained("mvp", "MvP", 9.77),
)
FITTING, MEAN, MEAN_ROTATED = (
    "`poem fit` to the first stage's points",
    "mean hand, true root",
    "mean hand, true root and rotation",
)


@dataclass(frozen=True)
class Condition:
    """Cameras on which all systems are tested."""

    rig: TableRig
    num_views: int
    change: Change | None = None

    @property
    def title(self) -> str:
        """In words."""
        first = "" if self.num_views == len(self.rig.cameras) else "the first "
        shuffled = "" if self.change is None else ", shuffled"
        return f"{self.rig.name}, {first}{self.num_views} cameras{shuffled}"

    def in_words(self, samples: int, batch_size: int, seed: int) -> str:
        """Say all that scores depend on; a change of the cameras is drawn for a batch."""
        how = "" if self.change is None else f" by {batch_size}, seed {seed}"
        return f"{self.title}, {samples} frames{how}"


CONDITIONS = (
    Condition(RING, 8),
    Condition(RING, 4),
    Condition(RING, 2),
    Condition(RING, 8, shuffle_cameras),
    Condition(FRONT, 5),
    Condition(CORNERS, 4),
)
_NOTES = (
    f"All systems are trained on captures of the rig `{RING.name}` alone; on `{FRONT.name}` and "
    f"`{CORNERS.name}` no camera stands where one stood in training. Trunk and heat maps are the shipped "
    "model's, for all, and stay as they are: they have seen random cameras.",
    "The recipe (rate, heads, steps, how query vectors begin) was changed after test errors of v2 and MvP "
    "under a first one had been seen; the choices were by training errors of v2 and v1, and of no other: "
    "docs/tables.md. Query vectors begin as sines of the template, which is not the paper's; one row begins "
    "without.",
    "Seeds are of the first weights, and in v1 of the basis points that training draws, not of the captures. "
    "± is the standard error over frames of the mean over seeds; what each seed gives stands beside it. The "
    "paper's rank is by MPVPE on DexYCB-Mv with 8 cameras, of the systems that it has there; its v2 was "
    "trained on six sets with cameras in random order, the others on DexYCB-Mv alone.",
    "Ranks of systems that differ by less than ± say nothing; v1 and those of its ablations that start from "
    "the joints are still about where they started: docs/tables.md.",
)


@dataclass(frozen=True)
class SyntheticTable:
    """An `AnyTable`; its rows are systems by condition."""

    name: str = "synthetic"
    title: str = "All systems trained alike on synthetic captures"

    def run(self, places: Places, settings: RunSettings) -> TableResult:
        """Score every system whose checkpoints are here; say of the others how they are made."""
        samples = TEST_FRAMES if settings.samples is None else min(settings.samples, TEST_FRAMES)
        opened = cache(partial(_opened, places))
        config, params = load(SHIPPED)
        fitting, first_stage = FirstStageFitting(config, params), checksum_of_first_stage(params)
        fit = f"{fitting.settings}, on {first_stage}"
        # A quick look leaves the scores of all frames alone.
        kept_in = Path(settings.out) / (KEPT if samples == TEST_FRAMES else f"{KEPT}_{samples}")
        fitted = ScoresFile(kept_in / FITTED, config, first_stage)
        files = {
            (system, seed): ScoresFile(
                kept_in / f"{system.name}-{seed}.npz", TABLE_MODELS[system.name], first_stage
            )
            for system in TRAINED
            for seed in SEEDS
        }
        lines: list[Line] = []
        gone: list[str | None] = []
        rig, captures = None, []
        for condition in tqdm(CONDITIONS, unit="condition", desc=self.name, disable=not settings.progress):
            if condition.rig is not rig:
                rig, captures = condition.rig, frames_of(condition.rig, samples)
            given = {
                "captures": captures,
                "num_views": condition.num_views,
                "batch_size": settings.batch_size,
                "change": condition.change,
                "seed": settings.seed,
            }
            score = partial(score_captures, **given)
            asked = condition.in_words(samples, settings.batch_size, settings.seed)
            question = Question(asked, marks_of(captures))
            of_fit, _ = fitted.scores(fit, Training(), question, partial(score, fitting))
            baselines = _baselines(captures, primary_cameras(**given), of_fit)
            group = [_line(condition, label, [scores], samples) for label, scores in baselines.items()]
            for system in TRAINED:
                seeds = {
                    seed: _result(system, seed, places, files[system, seed], opened, question, score)
                    for seed in SEEDS
                }
                group.append(_line_of_seeds(condition, system, seeds, samples))
                gone += [one.absent for one in seeds.values() if one.is_kept and one.absent not in gone]
            lines += ranked(group)
        return TableResult(self.name, self.title, tuple(lines), (*_NOTES, *_note_of_weights(gone)))


def _note_of_weights(gone: Iterable[str | None]) -> tuple[str, ...]:
    """Say how the models are made again whose scores alone are left."""
    models = [f"- {how}" for how in gone]
    return ("\n".join(["Weights gone or unreadable, scores kept:\n", *models]),) if models else ()


table = SyntheticTable()


class _SeedResult(NamedTuple):
    """What is known of one trained model in one condition."""

    scores: CaptureScores | None = None
    training: Training = Training()
    absent: str | None = None
    """What of it is missing, and how to make it."""

    @property
    def is_kept(self) -> bool:
        """Whether its scores are all that is left of it."""
        return self.scores is not None and self.absent is not None


def _result(
    system: Trained,
    seed: int,
    places: Places,
    kept: ScoresFile,
    opened: Callable[[Trained, int], System | str],
    question: Question,
    score: Callable[[System], CaptureScores],
) -> _SeedResult:
    """Score a model, or take the scores that were kept of it; say what is missing."""
    model = opened(system, seed)
    if isinstance(model, str):
        earlier = kept.scores_without_model(question)
        return _SeedResult(absent=model) if earlier is None else _SeedResult(*earlier, absent=model)
    folder, training = system.folder(places, seed), training_of(system.run(places, seed))
    try:
        return _SeedResult(*kept.scores(checksum_of(folder), training, question, partial(score, model)))
    except ValueError as error:  # One that diverged costs its own line alone.
        return _SeedResult(absent=f"{folder} could not be scored: {error}")


def _line_of_seeds(
    condition: Condition, system: Trained, seeds: Mapping[int, _SeedResult], samples: int
) -> Line:
    """Return the line of a system: what its models came to, how they were trained, and the paper's note."""
    scored = {seed: one.scores for seed, one in seeds.items() if one.scores is not None}
    line = _line(condition, system.label, list(scored.values()), samples, tuple(scored))
    said = {
        "training": "; ".join(
            f"{s}: {seeds[s].training.summary}" for s in scored if seeds[s].training.summary
        ),
        "weights gone, scores kept": ", ".join(f"{s}" for s in scored if seeds[s].is_kept),
    }
    return line._replace(
        what={**line.what, **{key: words for key, words in said.items() if words}},
        notes=(*line.notes, *((system.note,) if system.note else ())),
        absent=tuple(one.absent for one in seeds.values() if one.scores is None and one.absent is not None),
    )


def _opened(places: Places, system: Trained, seed: int) -> System | str:
    """Open a trained model; say how it is made if it is not there, or what is wrong with its folder."""
    missing = system.missing(places, seed)
    if missing is not None:
        return missing
    try:
        return Network(*load(system.folder(places, seed), expected=TABLE_MODELS[system.name]))
    except (OSError, ValueError) as error:
        return str(error)


def frames_of(rig: TableRig, samples: int) -> list[MultiViewBatch]:
    """Draw the first test frames of a rig, with all its cameras."""
    captures = SyntheticDataset(captures_of(rig, CAPTURES), seed=rig.test_seed)
    return [captures.sample(index) for index in range(samples)]


def ranked(lines: Sequence[Line]) -> list[Line]:
    """Give the systems of one condition their ranks, by error, beside the paper's.

    Baselines have none, and neither have systems above the mean hand with true root and rotation, which are
    marked; a rank is among the others.
    """
    bar = next(line.ours[ERROR] for line in lines if line.label == MEAN_ROTATED and line.ours is not None)
    papers = {system.label: system.paper_mm for system in TRAINED}
    in_paper = sorted(error for error in papers.values() if error is not None)
    errors = {
        line.label: line.ours[ERROR] for line in lines if line.ours is not None and line.label in papers
    }
    far_enough = sorted(error for error in errors.values() if error <= bar)
    of_paper = {
        name: (error, paper)
        for name, error in errors.items()
        if (paper := papers[name]) is not None and error <= bar
    }
    result = []
    for line in lines:
        error, paper = errors.get(line.label), papers.get(line.label)
        if error is not None and error > bar:
            line = line._replace(notes=(NOT_FAR_ENOUGH, *line.notes))
        ranks = {
            "rank": _place(error, far_enough),
            "of the paper's systems (in the paper)": _beside(line.label, of_paper),
            "paper's rank": _place(paper, in_paper),
        }
        result.append(line._replace(beside={**ranks, **line.beside}))
    return result


def _place(error: float | None, among: Sequence[float]) -> str:
    """Say which of the sorted errors one is; nothing where it is none of them."""
    return "" if error is None or error not in among else f"{among.index(error) + 1} of {len(among)}"


def _beside(name: str, numbers: Mapping[str, tuple[float, float]]) -> str:
    """Say a system's place among the same systems by our numbers, and by the paper's."""
    if name not in numbers:
        return ""
    ours, papers = (sorted(column) for column in zip(*numbers.values(), strict=True))
    error, paper = numbers[name]
    return f"{_place(error, ours)} ({papers.index(paper) + 1})"


def _baselines(
    captures: Sequence[MultiViewBatch],
    T_primary_from_world: Float[np.ndarray, "sample 4 4"],
    fitted: CaptureScores,
) -> dict[str, CaptureScores]:
    truth = truth_of(captures)
    return {
        MEAN: CaptureScores(score_hands(mean_hands(captures, T_primary_from_world), truth)),
        MEAN_ROTATED: CaptureScores(score_hands(mean_hands_rotated(captures), truth)),
        FITTING: fitted,
    }


def _line(
    condition: Condition,
    label: str,
    scores: Sequence[CaptureScores],
    samples: int,
    seeds: Sequence[int] = (),
) -> Line:
    """Return the line of a system: means over frames and seeds."""
    line = Line(
        group=condition.title,
        label=label,
        columns=AT_50_MM,
        paper={},
        num_views=condition.num_views if condition.rig is RING and condition.change is None else None,
        series=label,
    )
    if not scores:
        return line
    by_frame = {name: np.mean([one.rows[name] for one in scores], axis=0) for name in scores[0].rows}
    unsolved = sum(one.unsolved for one in scores)
    of_seeds = {
        f"MPVPE, seed {seed}": f"{one.rows[ERROR].mean():.2f}"
        for seed, one in zip(seeds, scores, strict=False)
    }
    return line._replace(
        ours={name: float(values.mean()) for name, values in by_frame.items()},
        spread={name: standard_error(values) for name, values in by_frame.items()},
        samples=samples,
        beside=of_seeds,
        what={"cameras": condition.title, "protocol": PROTOCOL},
        notes=(f"{unsolved} frames, in which the system found no hand, count with what it gave",)
        if unsolved
        else (),
    )
