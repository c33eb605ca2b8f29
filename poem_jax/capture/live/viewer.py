"""The live picture for the eye: what a frame shows, put into the scene that a browser looks at."""

from collections.abc import Mapping

from poem_jax.capture.frame import Frame
from poem_jax.capture.live.following import SIDES
from poem_jax.capture.live.pace import Figures
from poem_jax.capture.live.streams import check_port_is_free
from poem_jax.capture.outputs.page import make_gallery
from poem_jax.data.lens import take_picture
from poem_jax.geometry.rig import Rig
from poem_jax.typing import Array, Int
from poem_jax.viz.live_scene import LiveScene


class LiveViewer:
    """Shows frames, as long as somebody looks."""

    def __init__(self, rig: Rig, faces: Mapping[str, Int[Array, "face 3"]], host: str, port: int) -> None:
        """Begin to serve the scene.

        Raises:
            ValueError: The port cannot be used.
        """
        check_port_is_free(host, port, "--viewer")
        self._gallery = make_gallery(rig, None)
        self._scene = LiveScene(self._gallery.cameras, faces, host, port)

    def show(self, frame: Frame) -> None:
        """Show a frame's hands; its pictures only now and then."""
        if not self._scene.is_watched:
            return
        hands = zip(SIDES, frame.hands, strict=True)
        self._scene.show_hands(
            {side: hand.vertices_world for side, hand in hands if hand.vertices_world is not None}
        )
        if self._scene.wants_pictures:
            views = zip(frame.images, self._gallery.maps, strict=True)
            pictures = [None if image is None else take_picture(image, at) for image, at in views]
            self._scene.show_pictures(pictures)

    def tell(self, figures: Figures) -> None:
        """Show how the line keeps up."""
        latency, most = figures.latency_ms
        self._scene.tell(
            f"**{figures.rate:.1f}** moments/s, latency **{latency:.0f}** ms (95 %: {most:.0f})\n\n"
            f"{figures.dropped} of {figures.offered} moments dropped in {figures.seconds:.0f} s"
        )

    def close(self) -> None:
        """Stop serving."""
        self._scene.close()
