"""The take: its pictures one moment after the other, and what is true of it."""

from functools import cache
from typing import NamedTuple

import numpy as np

from poem_jax.synthetic.desk.body import body_surface
from poem_jax.synthetic.desk.cameras import desk_rig, frame_times
from poem_jax.synthetic.desk.light import light_vertices
from poem_jax.synthetic.desk.motion import SIDES, hands_at
from poem_jax.synthetic.desk.picture import Picture, take_picture
from poem_jax.synthetic.desk.room import room_surface
from poem_jax.synthetic.desk.surface import Surface, join
from poem_jax.typing import Array, Float


class Truth(NamedTuple):
    """Both hands in every frame, float32: metres, world frame, hands in the order of `hand_side`."""

    vertices_world: Float[Array, "frame hand 778 3"]
    joints_world: Float[Array, "frame hand 21 3"]
    hand_side: tuple[str, ...] = SIDES


def desk_truth() -> Truth:
    """Return where the hands are."""
    moments = [hands_at(time) for time in frame_times()]
    return Truth(
        np.stack([hands.vertices_world for hands in moments]),
        np.stack([hands.joints_world for hands in moments]),
    )


def desk_pictures(frame: int, views: tuple[int, ...] = (0, 1, 2, 3)) -> list[Picture]:
    """Draw a frame as the given cameras see it; a second or so a picture."""
    rig = desk_rig()
    scene = join([body_surface(hands_at(frame_times()[frame])), _room()])
    lit = light_vertices(scene)
    return [take_picture(scene, lit, rig, view, frame) for view in views]


@cache
def _room() -> Surface:
    return room_surface()
