"""Scores of trained models, kept beside the table: one of many models is made in more sittings than one, and
stands when their weights, which are large, are gone.

A file a model: every metric of every frame, by condition, and what it was made of. It counts for the very
same weights where these are there, else for a model of the same config; always for the same captures.
"""

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.evaluation.captures import CaptureScores
from poem_jax.io.atomic import whole_file
from poem_jax.io.npz_file import read_npz
from poem_jax.models.config import ModelConfig
from poem_jax.weights.config_json import to_json
from poem_jax.weights.store import CHECKSUMS_FILE

_log = logging.getLogger(__name__)
_ABOUT, _UNSOLVED = "about", "unsolved"


@dataclass(frozen=True)
class Asked:
    """What scores depend on beside the model."""

    condition: str
    """Cameras, number of frames, and all else that can be said in words."""
    captures: str
    """Their `fingerprint`."""


@dataclass(frozen=True)
class KeptModel:
    """A model's scores and what it was trained by, in one file."""

    file: Path
    config: ModelConfig

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
        content = self._read()
        if content.get(_ABOUT, {}).get("weights") != weights:
            content = {}
        kept = _found(content, asked)
        if kept is not None:
            _log.info("%s: scored before; %s", asked.condition, self.file)
            return kept
        scores = _rounded(score())
        about = content.get(_ABOUT, {"conditions": {}})
        about |= {"weights": weights, "config": _fingerprint_of(self.config)}
        about |= {"training": training or about.get("training", "")}
        about["conditions"][asked.condition] = {"captures": asked.captures, _UNSOLVED: scores.unsolved}
        self._write({**content, _ABOUT: about, asked.condition: scores.rows})
        return scores

    def scores_without_model(self, asked: Asked) -> tuple[CaptureScores, str] | None:
        """Return what was kept of a model of this config whose weights are gone, and how it was trained."""
        content = self._read()
        about = content.get(_ABOUT, {})
        if about.get("config") != _fingerprint_of(self.config):
            return None
        kept = _found(content, asked)
        return None if kept is None else (kept, str(about.get("training", "")))

    def _read(self) -> dict[str, Any]:
        """Return what was kept; nothing where there is none, or where it is damaged, which is told."""
        if not self.file.exists():
            return {}
        try:
            arrays = read_npz(self.file, required=[_ABOUT])
            about = json.loads(str(arrays[_ABOUT]))
            rows = {
                condition: {name: arrays[f"{condition}/{name}"] for name in said["metrics"]}
                for condition, said in about["conditions"].items()
            }
            return {_ABOUT: about, **rows}
        except (OSError, ValueError, TypeError, KeyError) as error:
            _log.warning("%s cannot be read and is made anew: %s", self.file, error)
            return {}

    def _write(self, content: dict[str, Any]) -> None:
        about, arrays = content[_ABOUT], {}
        for condition, said in about["conditions"].items():
            said["metrics"] = sorted(content[condition])
            arrays |= {f"{condition}/{name}": values for name, values in content[condition].items()}
        arrays[_ABOUT] = np.array(json.dumps(about))
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(self.file) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **arrays)
        except OSError as error:
            _log.warning("%s: scores are not kept: %s", self.file, error)


def fingerprint(captures: Sequence[MultiViewBatch]) -> str:
    """Return a checksum of images, cameras and labels of captures."""
    digest = hashlib.sha256()
    for one in captures:
        for array in (one.views, *one.cameras, one.joints_world, one.vertices_world):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _found(content: dict[str, Any], asked: Asked) -> CaptureScores | None:
    said = content.get(_ABOUT, {}).get("conditions", {}).get(asked.condition)
    if said is None or said["captures"] != asked.captures:
        return None
    return CaptureScores(content[asked.condition], said[_UNSOLVED])


def _rounded(scores: CaptureScores) -> CaptureScores:
    """Return scores as they are kept, so that a table is the same when it is made again."""
    return scores._replace(rows={name: values.astype(np.float32) for name, values in scores.rows.items()})


def _fingerprint_of(config: ModelConfig) -> str:
    return hashlib.sha256(to_json(config).encode()).hexdigest()
