"""The process of the PyTorch release: `python -m torch_release.answer FOLDER`.

FOLDER holds the weights and the inputs, as `against_release.py` writes them.
"""

import functools
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports]

from .layers import as_images, load_released
from .turns import peak_gb, serve
from .v1 import PoemV1
from .v2 import Constants, PoemV2

_FORMATS = {"channels-last": torch.channels_last, "NCHW": torch.contiguous_format}


class Release:
    """The networks, loaded when they are first asked for."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._network = functools.cache(self._load_network)
        self._case = functools.cache(self._load_case)

    def run(self, network: str, case: str, form: str) -> float:
        """Return the seconds of one call, from uint8 images to query points."""
        model, inputs = self._network(network, form), self._case(case)
        start = time.perf_counter()
        self._points(model, inputs, form)
        return time.perf_counter() - start

    def distances(self, network: str, case: str, form: str) -> list[float]:
        """Return the distance of each query point from the stored one, metres."""
        model, inputs = self._network(network, form), self._case(case)
        index = inputs.get("ball_index")
        given = {} if index is None else {"ball_index": torch.from_numpy(index).long()}
        points = self._points(model, inputs, form, **given)
        return np.linalg.norm(points.numpy() - inputs["points"], axis=-1).tolist()

    @torch.inference_mode()
    def _points(self, model: PoemV1 | PoemV2, inputs: dict[str, np.ndarray], form: str, **given: Any) -> Any:
        """Return the query points of the one sample (799, 3)."""
        images = as_images(inputs["images"], _FORMATS[form])
        K, E = torch.from_numpy(inputs["K"]), torch.from_numpy(inputs["E"])
        if isinstance(model, PoemV1):
            return model(images, K[None], E[None], **given).layers[-1, 0]
        return model(images, K, E, [len(images)], torch.from_numpy(inputs["joints"])[None]).layers[-1, 0]

    def _load_network(self, network: str, form: str) -> PoemV1 | PoemV2:
        if network == "v1":
            model = PoemV1()
        else:
            with np.load(self._folder / "constants.npz") as arrays:
                model = PoemV2(Constants.of(arrays))
        with np.load(self._folder / f"{network}.npz") as state:
            load_released(model, state)
        return model.eval().to(memory_format=_FORMATS[form])

    def _load_case(self, case: str) -> dict[str, np.ndarray]:
        with np.load(self._folder / f"{case}.npz") as arrays:
            return dict(arrays)


if __name__ == "__main__":
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    release = Release(Path(sys.argv[1]))
    answers = {"run": release.run, "distances": release.distances, "peak": peak_gb}
    serve(answers | {"version": lambda: f"torch {torch.__version__}"})
