"""`poem live`."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from poem_jax.cli.fit import hand_from
from poem_jax.cli.messages import say
from poem_jax.cli.options import File, Flag, OptionalFile, OptionalFolder

if TYPE_CHECKING:
    from poem_jax.capture.frame import Frame
    from poem_jax.capture.live.engines import LiveEngine
    from poem_jax.capture.live.line import Send
    from poem_jax.capture.live.pace import Pace
    from poem_jax.capture.live.viewer import LiveViewer
    from poem_jax.geometry.rig import Rig

_TOLD_S = 5.0


@dataclass(frozen=True)
class Live:
    """Reconstruct both hands while the cameras run: the newest moment at once, the others are dropped.

    Shows them in a browser, and sends their joints to other programs; see docs/live.md. Ctrl-C ends it.
    """

    rig: File
    """Calibration, in any format that is read."""
    source: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DIR|CAMERA=WHAT")]
    """CAMERA=0 CAMERA=1 ...: devices; CAMERA=rtsp://...: network cameras; CAMERA=a.mp4 ..., or a take's
    folder: played as if it ran now."""
    loop: Flag = False
    """Play a take or videos again and again."""
    engine: Literal["fit", "poem"] = "fit"
    """fit: the hand model, from key points. poem: the network, from the images."""
    checkpoint: OptionalFolder = None
    """Of the network, as for `poem reconstruct`."""
    mano: OptionalFile = None
    """Of the fit, as for `poem fit`."""
    raw: Flag = False
    """Every moment as it is, without the filter that calms the hands."""
    bridge: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 0.2
    """For how long a hand that is not seen stays where it was; 0: never. Not with --raw."""
    udp: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Send the joints there, a JSON message a moment."""
    websocket: Annotated[int | None, tyro.conf.arg(metavar="PORT")] = None
    """Send the same to all who connect to ws://HOST:PORT."""
    viewer: Annotated[int, tyro.conf.arg(metavar="PORT")] = 8080
    """Where the browser finds the picture; 0: none."""
    host: str = "127.0.0.1"
    """Of viewer and websocket; 0.0.0.0: for other machines, too."""
    seconds: float | None = None
    """End after so long."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Run until the cameras end, or a signal comes; print how it kept up."""
        from poem_jax.calibration.read_calibration import read_calibration
        from poem_jax.capture.live.newest import NewestShots
        from poem_jax.capture.live.pace import Pace
        from poem_jax.capture.live.sources import open_source
        from poem_jax.detection import compile_programs

        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"--seconds must be more than 0; got {self.seconds:g}")
        rig = read_calibration(self.rig)
        with ExitStack() as opened:
            streams = self._streams(opened)
            engine = self._engine(rig)
            viewer = self._viewer(rig, engine, opened)
            source = open_source(self.source, rig, loop=self.loop)
            opened.callback(source.close)
            say("the first run on a machine compiles its programs, once")
            compile_programs()
            engine.compile()
            shots = NewestShots(rig.num_views)
            pace = Pace(shots.clock, shots.begin_s)
            source.start(shots)
            say("running; Ctrl-C ends it")
            try:
                for frame in self._frames(shots, rig, engine, streams, pace):
                    self._tell(frame, pace, viewer)
                    if self.seconds is not None and shots.clock() - shots.begin_s >= self.seconds:
                        break
            finally:
                print(pace.figures(), flush=True)

    def _streams(self, opened: ExitStack) -> "list[Send]":
        from poem_jax.capture.live.streams import UdpStream, WebsocketStream, parse_receiver

        streams: list[Any] = []
        if self.udp is not None:
            streams.append(UdpStream(*parse_receiver(self.udp)))
        if self.websocket is not None:
            streams.append(WebsocketStream(self.host, self.websocket))
            say(f"joints are sent to who connects to ws://{self.host}:{self.websocket}")
        for stream in streams:
            opened.callback(stream.close)
        return [stream.send for stream in streams]

    def _engine(self, rig: "Rig") -> "LiveEngine":
        from poem_jax.capture.live.engines import live_fit, live_network
        from poem_jax.capture.network import load_network
        from poem_jax.hand.pair import hands_of
        from poem_jax.hand.template import default_hand

        if self.engine == "poem":
            if self.mano is not None:
                raise ValueError("--mano is for --engine fit; the network has its own hand")
            return live_network(rig, load_network(self.checkpoint))
        if self.checkpoint is not None:
            raise ValueError("--checkpoint is for --engine poem; a fit has no weights")
        hand = hand_from(self.mano)
        return live_fit(rig, hands_of(default_hand() if hand is None else hand))

    def _viewer(self, rig: "Rig", engine: "LiveEngine", opened: ExitStack) -> "LiveViewer | None":
        from poem_jax.capture.live.viewer import LiveViewer

        if not self.viewer:
            return None
        viewer = LiveViewer(rig, engine.faces, self.host, self.viewer)
        opened.callback(viewer.close)
        say(f"look at http://{self.host}:{self.viewer}")
        return viewer

    def _frames(
        self, shots: Any, rig: "Rig", engine: "LiveEngine", streams: "Sequence[Send]", pace: "Pace"
    ) -> Any:
        from poem_jax.capture.live.line import run_line
        from poem_jax.capture.smoothing import Smoothing
        from poem_jax.detection import HandTrackers

        smoothing = Smoothing("off") if self.raw else Smoothing("causal", self.bridge)
        detector = HandTrackers(rig.num_views).find_hands
        return run_line(shots, rig, detector, engine, smoothing, streams, pace)

    def _tell(self, frame: "Frame", pace: "Pace", viewer: "LiveViewer | None") -> None:
        if viewer is not None:
            viewer.show(frame)
        if (figures := pace.lap(_TOLD_S)) is not None:
            say(str(figures))
            if viewer is not None:
                viewer.tell(figures)
