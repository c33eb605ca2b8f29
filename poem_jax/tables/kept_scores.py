"""Scores of trained models, kept beside the table: one of many models is made in more sittings than one, and
stands when their weights, which are large, are gone.

A file a model: every metric of every frame, by condition, and what it was made of. It counts for the very
same weights where these are there, else for a model of the same config; always for the same captures. Kept
are half numbers, three digits a frame, which are what the table is made of the first time, too.
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
from poem_jax.hand.topology import ROOT_JOINT
from poem_jax.io.atomic import whole_file
from poem_jax.io.npz_file import read_npz
from poem_jax.models.config import ModelConfig
from poem_jax.typing import Float
from poem_jax.weights.config_json import to_json
from poem_jax.weights.store import CHECKSUMS_FILE

_log = logging.getLogger(__name__)
_ABOUT = "about"
_EVERY = 10
"""Captures of which one is looked at, to know them again."""
_TOLERANCES = (1e-4, 1e-4, 1e-4, 0.1)
"""Of `known_by`, metres and grey levels: machines round differently."""

KnownBy = Float[np.ndarray, "sample 4"]


@dataclass(frozen=True)
class Asked:
    """What scores depend on beside the model."""

    condition: str
    """Cameras, number of frames, and all else that can be said in words."""
    captures: KnownBy


class _Condition(NamedTuple):
    captures: KnownBy
    scores: CaptureScores


class KeptScores(NamedTuple):
    """Of a file."""

    weights: str
    """Checksum of the weights' checksums."""
    config: str
    """Checksum of the model's config."""
    training: str
    conditions: dict[str, _Condition]

    def found(self, asked: Asked) -> CaptureScores | None:
        """Return the scores that were asked for, if they are here."""
        kept = self.conditions.get(asked.condition)
        if kept is None or kept.captures.shape != asked.captures.shape:
            return None
        same = np.all(np.abs(kept.captures - asked.captures) < _TOLERANCES)
        return kept.scores if same else None


@dataclass(frozen=True)
class KeptModel:
    """A model's scores and how it was trained, in one file."""

    file: Path
    config: ModelConfig

    @property
    def checksum(self) -> str:
        """Of the config."""
        return hashlib.sha256(to_json(self.config).encode()).hexdigest()

    def scores(
        self, model: Path, training: str, asked: Asked, score: Callable[[], CaptureScores]
    ) -> CaptureScores:
        """Return what was kept of the same weights, else score and keep it.

        Args:
            model: folder of the checkpoint.
            training: how it was trained, in words; kept with the scores.
            asked: captures and condition.
            score: computes them.

        Raises:
            ValueError: `score` cannot; nothing is kept.
        """
        weights = hashlib.sha256((model / CHECKSUMS_FILE).read_bytes()).hexdigest()
        content = self.read()
        if content is None or content.weights != weights:
            content = KeptScores(weights, self.checksum, training, {})
        kept = content.found(asked)
        if kept is not None:
            _log.info("%s: scored before; %s", asked.condition, self.file)
            return kept
        scores = _rounded(score())
        conditions = {**content.conditions, asked.condition: _Condition(asked.captures, scores)}
        self._write(content._replace(training=training or content.training, conditions=conditions))
        return scores

    def scores_without_model(self, asked: Asked) -> tuple[CaptureScores, str] | None:
        """Return what was kept of a model of this config whose weights are gone, and how it was trained."""
        content = self.read()
        if content is None or content.config != self.checksum:
            return None
        kept = content.found(asked)
        return None if kept is None else (kept, content.training)

    def read(self) -> KeptScores | None:
        """Return what was kept; None where there is nothing, or where it is damaged, which is told."""
        if not self.file.exists():
            return None
        try:
            arrays = read_npz(self.file, required=[_ABOUT])
            about = json.loads(str(arrays[_ABOUT]))
            conditions = {
                name: _Condition(
                    np.array(said["captures"]),
                    CaptureScores(
                        {metric: arrays[f"{name}/{metric}"].astype(np.float64) for metric in said["metrics"]},
                        said["unsolved"],
                    ),
                )
                for name, said in about["conditions"].items()
            }
            return KeptScores(about["weights"], about["config"], about["training"], conditions)
        except (OSError, ValueError, TypeError, KeyError) as error:
            _log.warning("%s cannot be read and is made anew: %s", self.file, error)
            return None

    def _write(self, content: KeptScores) -> None:
        arrays, said = {}, {}
        for name, (captures, scores) in content.conditions.items():
            said[name] = {
                "captures": np.round(captures, 5).tolist(),
                "metrics": list(scores.rows),
                "unsolved": scores.unsolved,
            }
            for metric, values in scores.rows.items():
                arrays[f"{name}/{metric}"] = values.astype(_half_if_it_holds(values))
        arrays[_ABOUT] = np.array(json.dumps({**content._asdict(), "conditions": said}))
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(self.file) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **arrays)
        except OSError as error:
            _log.warning("%s: scores are not kept: %s", self.file, error)


def known_by(captures: Sequence[MultiViewBatch]) -> KnownBy:
    """Return the root joint, metres, and the mean grey level of every tenth capture.

    No checksum: the same captures differ in a last digit or a pixel's last bit from machine to machine.
    """
    return np.array([(*one.joints_world[ROOT_JOINT], np.mean(one.views)) for one in captures[::_EVERY]])


def _rounded(scores: CaptureScores) -> CaptureScores:
    """Return scores as they are kept, so that a table is the same when it is made again."""
    rows = {
        name: values.astype(_half_if_it_holds(values)).astype(np.float64)
        for name, values in scores.rows.items()
    }
    return scores._replace(rows=rows)


def _half_if_it_holds(values: Float[np.ndarray, " sample"]) -> np.dtype:
    """Return half numbers, or where one is beyond them (65 m), double ones."""
    fits = bool(np.all(np.abs(values) < np.finfo(np.float16).max))
    return np.dtype(np.float16 if fits else np.float64)
