"""What a lens does not show, in words."""

import numpy as np

from poem_jax.geometry.distortion import WIDEST_ANGLE
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Int


def beyond_the_lens(rig: Rig, lost: Int[Array, " view"], what: str) -> list[str]:
    """Say for each camera what lies in its image where its lens has no ray; [] = nothing.

    Args:
        rig: The cameras.
        lost: How many by camera.
        what: Of what: `hands`, `key points`.
    """
    return [
        f"camera '{name}': {count} {what} lie where "
        + (
            f"its fisheye looks more than {np.degrees(WIDEST_ANGLE):.0f} degrees aside, "
            "which no flat picture shows"
            if fisheye
            else "its lens has no ray, by its distortion"
        )
        + ": they count as unseen"
        for name, count, fisheye in zip(rig.names, lost, rig.fisheye, strict=True)
        if count
    ]
