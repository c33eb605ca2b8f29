"""What a format cannot hold of a rig, said by name before anything is written."""

import numpy as np

from poem_jax.geometry.distortion import TERM_COUNTS, shortest_terms
from poem_jax.geometry.rig import Rig

_LONGER = {8: "the rational terms k4 k5 k6", 12: "thin prisms", 14: "a tilted sensor"}


def check_no_skew(rig: Rig, what: str) -> None:
    """Raise a ValueError where a camera's axes are not at right angles."""
    for name, K in zip(rig.names, rig.K, strict=True):
        if abs(K[0, 1]) > 1e-9:
            raise ValueError(
                f"{what} cannot hold the skew of camera '{name}', {K[0, 1]:.3g} px; choose another format"
            )


def check_no_fisheye(rig: Rig, what: str) -> None:
    """Raise a ValueError where a camera has a fisheye."""
    for name, fisheye in zip(rig.names, rig.fisheye, strict=True):
        if fisheye:
            raise ValueError(f"{what} cannot hold the fisheye of camera '{name}'; choose another format")


def check_term_count(rig: Rig, most: int, what: str) -> None:
    """Raise a ValueError where a pinhole has more terms than `most`."""
    for name, fisheye, dist in zip(rig.names, rig.fisheye, rig.dist, strict=True):
        terms = shortest_terms(np.asarray(dist, np.float64))
        if not fisheye and np.trim_zeros(terms, "b").size > most:
            longer = next(count for count in TERM_COUNTS if count >= len(terms))
            lens = _LONGER.get(longer, "the term k3")
            raise ValueError(f"{what} cannot hold {lens} of camera '{name}'; choose another format")
