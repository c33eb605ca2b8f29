"""The take: the pictures of every moment."""

from functools import cache

from poem_jax.synthetic.desk.body import body_surface
from poem_jax.synthetic.desk.cameras import desk_rig, frame_times
from poem_jax.synthetic.desk.light import light_vertices
from poem_jax.synthetic.desk.motion import hands_at
from poem_jax.synthetic.desk.picture import Picture, take_picture
from poem_jax.synthetic.desk.room import room_surface
from poem_jax.synthetic.desk.surface import Surface, join


def desk_pictures(frame: int, views: tuple[int, ...] = (0, 1, 2, 3)) -> list[Picture]:
    """Draw a frame as the given cameras see it; a second or so a picture."""
    rig = desk_rig()
    scene = join([body_surface(hands_at(frame_times()[frame])), _room()])
    lit = light_vertices(scene)
    return [take_picture(scene, lit, rig, view, frame) for view in views]


@cache
def _room() -> Surface:
    return room_surface()
