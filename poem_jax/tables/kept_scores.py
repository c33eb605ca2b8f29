"""Scores kept beside the folder of a trained model: a table of many is made in more than one sitting."""

import hashlib
import json
import logging
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.evaluation.captures import CaptureScores
from poem_jax.io.atomic import whole_file
from poem_jax.weights.store import CHECKSUMS_FILE, CONFIG_FILE

_log = logging.getLogger(__name__)


def kept_scores(
    model: Path, condition: str, captures: str, score: Callable[[], CaptureScores]
) -> CaptureScores:
    """Return what was kept of the same weights on the same captures, else score and keep it.

    Args:
        model: folder of a checkpoint; scores lie in `MODEL.scores/`. Remove that after a change of the code.
        condition: cameras, and all else that scores depend on.
        captures: their `fingerprint`.
        score: computes them.
    """
    words = "-".join(re.findall(r"\w+", condition))
    file = model.with_name(f"{model.name}.scores") / f"{words}.json"
    made_of = {"condition": condition, "captures": captures, "weights": _fingerprint_of_model(model)}
    kept = _read(file)
    if kept.get("of") == made_of:
        _log.info("%s: scored before; %s", condition, file)
        return CaptureScores({n: np.array(values) for n, values in kept["rows"].items()}, kept["unsolved"])
    scores = score()
    rows = {name: values.tolist() for name, values in scores.rows.items()}
    text = json.dumps({"of": made_of, "unsolved": scores.unsolved, "rows": rows}, allow_nan=False)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(file) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        _log.warning("%s: scores are not kept: %s", condition, error)
    return scores


def fingerprint(captures: Sequence[MultiViewBatch]) -> str:
    """Return a checksum of images, cameras and labels of captures."""
    digest = hashlib.sha256()
    for one in captures:
        for array in (one.views, *one.cameras, one.joints_world, one.vertices_world):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _read(file: Path) -> dict[str, Any]:
    """Return what was kept; nothing where there is none, or where it is damaged, which is told."""
    if not file.exists():
        return {}
    try:
        return dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        _log.warning("%s cannot be read and is scored anew: %s", file, error)
        return {}


def _fingerprint_of_model(folder: Path) -> str:
    """Return a checksum of the config and of the checksums of the weights."""
    parts = [(folder / name).read_bytes() for name in (CONFIG_FILE, CHECKSUMS_FILE)]
    return hashlib.sha256(b"".join(parts)).hexdigest()
