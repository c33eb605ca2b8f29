"""Scores of trained models, kept beside the table: one of many models is made in more sittings than one, and
stands when their weights, which are large, are gone.

A file a model: every metric of every frame, by condition, and what it was made of. It counts for the very
same weights where these are there, else for a model of the same config on the same first stage; always for
the same captures. Kept are half numbers, three digits a frame, which are what the table is made of
the first time, too.
"""

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.evaluation.captures import CaptureScores
from poem_jax.io.atomic import whole_file
from poem_jax.io.npz_file import read_npz
from poem_jax.models.config import ModelConfig
from poem_jax.models.network import is_of_first_stage
from poem_jax.tables.training_summary import Training
from poem_jax.typing import Float, Params
from poem_jax.weights.config_json import from_json, to_json
from poem_jax.weights.store import CHECKSUMS_FILE, checksum_of_leaves, flatten

_log = logging.getLogger(__name__)
_ABOUT = "about"
_EVERY = 25
"""Captures of which one is looked at, to know them again."""
_VERTICES = slice(0, None, 97)


class Marks(NamedTuple):
    """What some of the captures are known by. No checksum: the same ones differ in a last digit, or a pixel's
    last bit, from machine to machine."""

    points: Float[np.ndarray, "some point 3"]
    """Joints and some vertices of the hands, metres."""
    cameras: Float[np.ndarray, "some view 18"]
    """Upper rows of each T_cam_from_world, and of each K over the image's width."""
    grey: Float[np.ndarray, "some view"]
    """Mean level of each picture, 0 to 255."""

    def agree(self, others: "Marks") -> bool:
        """Say whether they are of the same captures, but for rounding: 0.1 mm, 1e-4 radians, 0.2 levels."""
        if any(a.shape != b.shape for a, b in zip(self, others, strict=True)):
            return False
        close = (np.abs(a - b) < limit for a, b, limit in zip(self, others, (1e-4, 1e-4, 0.2), strict=True))
        return all(np.all(one) for one in close)


@dataclass(frozen=True)
class Question:
    """What scores depend on beside the model."""

    condition: str
    """Cameras, number of frames, and all else that can be said in words."""
    captures: Marks


class _Answer(NamedTuple):
    captures: Marks
    scores: CaptureScores


class KeptScores(NamedTuple):
    """What a file holds."""

    weights: str
    """`checksum_of` the model; of a fit, which has none, its settings and first stage in words."""
    first_stage: str
    """`checksum_of_first_stage` of the model that lends it."""
    config: ModelConfig
    training: Training
    conditions: dict[str, _Answer]

    def answer(self, question: Question) -> CaptureScores | None:
        """Return the scores that are asked for, if they are here."""
        kept = self.conditions.get(question.condition)
        return kept.scores if kept is not None and kept.captures.agree(question.captures) else None


@dataclass(frozen=True)
class ScoresFile:
    """Where a model's scores are kept."""

    path: Path
    config: ModelConfig
    """Of the model."""
    first_stage: str
    """`checksum_of_first_stage` of the one that all systems have."""

    def scores(
        self, weights: str, training: Training, question: Question, score: Callable[[], CaptureScores]
    ) -> tuple[CaptureScores, Training]:
        """Return what was kept of the same weights, else score and keep it; and how they were trained.

        Args:
            weights: what tells the model from others: `KeptScores.weights`.
            training: how it was trained, as far as that is known; kept with the scores.
            question: captures and condition.
            score: computes them.

        Raises:
            ValueError: `score` cannot; nothing is kept.
        """
        kept = self.read()
        if kept is None or (kept.weights, kept.config) != (weights, self.config):
            kept = KeptScores(weights, self.first_stage, self.config, training, {})
        # The run's folder may hold another run by now.
        training = kept.training if kept.training.summary else training
        scores = kept.answer(question)
        if scores is not None and training == kept.training:
            _log.info("%s: scored before; %s", question.condition, self.path)
            return scores, training
        scores = _rounded(score()) if scores is None else scores
        conditions = {**kept.conditions, question.condition: _Answer(question.captures, scores)}
        self._write(kept._replace(training=training, conditions=conditions))
        return scores, training

    def scores_without_model(self, question: Question) -> tuple[CaptureScores, Training] | None:
        """Return what was kept of a model of this config whose weights are gone; the log says what does not
        fit."""
        kept = self.read()
        if kept is None:
            return None
        if (kept.first_stage, kept.config) != (self.first_stage, self.config):
            _log.warning("%s is of another config, or of another first stage", self.path)
            return None
        scores = kept.answer(question)
        if scores is None:
            _log.warning("%s has no scores of these captures: %s", self.path, question.condition)
            return None
        return scores, kept.training

    def read(self) -> KeptScores | None:
        """Return what was kept; None where there is nothing, or where it is damaged, which is told."""
        if not self.path.exists():
            return None
        try:
            arrays = read_npz(self.path, required=[_ABOUT])
            about = json.loads(str(arrays[_ABOUT]))
            conditions = {
                name: _Answer(
                    Marks(*(arrays[f"{name}/{mark}"] for mark in Marks._fields)),
                    CaptureScores(
                        dict(zip(said["metrics"], arrays[f"{name}/scores"].astype(np.float64), strict=True)),
                        said["unsolved"],
                    ),
                )
                for name, said in about["conditions"].items()
            }
            training = Training(*about["training"])
            config = from_json(about["config"])
            return KeptScores(about["weights"], about["first_stage"], config, training, conditions)
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            _log.warning("%s cannot be read, and its scores are made anew: %s", self.path, error)
            return None

    def _write(self, kept: KeptScores) -> None:
        arrays, said = {}, {}
        for name, (captures, scores) in kept.conditions.items():
            said[name] = {"metrics": list(scores.rows), "unsolved": scores.unsolved}
            arrays |= {f"{name}/{mark}": values for mark, values in captures._asdict().items()}
            arrays[f"{name}/scores"] = _narrowed(np.stack(list(scores.rows.values())))
        about = {**kept._asdict(), "config": to_json(kept.config), "conditions": said}
        arrays[_ABOUT] = np.array(json.dumps(about))
        try:
            if self.path.exists() and self.read() is None:
                self.path.replace(self.path.with_suffix(".damaged"))
            with whole_file(self.path) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **arrays)
        except OSError as error:
            _log.warning("%s: scores are not kept: %s", self.path, error)


def checksum_of(model: Path) -> str:
    """Return a checksum of the weights in a folder, by those that they were sealed with."""
    return hashlib.sha256((model / CHECKSUMS_FILE).read_bytes()).hexdigest()


def checksum_of_first_stage(params: Params) -> str:
    """Return a checksum of a model's trunk and heat maps, whatever comes after them."""
    return checksum_of_leaves(
        {name: leaf for name, leaf in flatten(params).items() if is_of_first_stage(name)}
    )


def marks_of(captures: Sequence[MultiViewBatch]) -> Marks:
    """Look at every 25th capture."""
    some = captures[::_EVERY]
    K, T_cam_from_world = (np.stack([one.cameras[i] for one in some]).astype(np.float64) for i in (0, 1))
    width = some[0].views.shape[-2]
    numbers = (
        x[..., :rows, :].reshape(*K.shape[:2], -1) for x, rows in ((T_cam_from_world, 3), (K / width, 2))
    )
    points = [np.concatenate([one.joints_world, one.vertices_world[_VERTICES]]) for one in some]
    grey = [np.mean(one.views, (1, 2, 3)) for one in some]
    return Marks(*(np.asarray(x, np.float32) for x in (points, np.concatenate(list(numbers), -1), grey)))


def _rounded(scores: CaptureScores) -> CaptureScores:
    """Return scores as they are kept, so that a table is the same when it is made again."""
    kept = _narrowed(np.stack(list(scores.rows.values()))).astype(np.float64)
    return scores._replace(rows=dict(zip(scores.rows, kept, strict=True)))


def _narrowed(values: Float[np.ndarray, "metric sample"]) -> Float[np.ndarray, "metric sample"]:
    """Return half numbers, or where one is beyond them (65 m), as it is."""
    return values.astype(np.float16) if np.all(np.abs(values) < np.finfo(np.float16).max) else values
