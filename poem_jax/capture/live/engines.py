"""The engines of the live line: one moment in, its hands out, with programs that are compiled beforehand.

Of a hand that is fitted the shape is not known at first: it is found together with the poses of a few moments
that lie a while apart, three times as they become more, and held; all other fits are of one moment alone.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.capture.agreement import check_each_camera
from poem_jax.capture.boxes_file import boxes_from_keypoints
from poem_jax.capture.crop import crop_hands, hand_squares
from poem_jax.capture.fit import MIN_VIEWS, fit_config, fit_group, fitted_hand
from poem_jax.capture.fit_trust import joint_confidence
from poem_jax.capture.frame import Frame, HandResult, too_few_views
from poem_jax.capture.live.following import SIDES
from poem_jax.capture.network import Network, check_rig, predict_hands
from poem_jax.capture.take import Take
from poem_jax.fitting.detector_offsets import MEDIAPIPE_HANDS, offsets_of
from poem_jax.fitting.kinematics import KeypointModel, keypoint_model
from poem_jax.geometry.rig import Rig
from poem_jax.hand.pair import Hands
from poem_jax.hand.topology import NUM_JOINTS
from poem_jax.typing import Array, Float, Int

if TYPE_CHECKING:
    from poem_jax.fitting import FitResult

MOMENTS_FOR_SHAPE = 16
"""So many settle a hand's shape."""
_SETTLED_AT = (1, 4, MOMENTS_FOR_SHAPE)
"""When it is found anew, together with the poses of all kept moments: that takes a while."""
_APART_S = 0.2
"""They lie so far apart at least: neighbours show the same."""


class LiveEngine(NamedTuple):
    """What finds hands in frames with images and key points."""

    run: Callable[[Iterable[Frame]], Iterator[Frame]]
    """A frame goes out before the next is taken."""
    compile: Callable[[], None]
    """Makes its programs, so that no moment waits for them."""
    faces: Mapping[str, Int[Array, "face 3"]]
    """Triangles by side."""
    hands: Hands | None
    """The hand models that its meshes are of; None = not known."""


def live_fit(rig: Rig, hands: Hands, detector: str | None = MEDIAPIPE_HANDS) -> LiveEngine:
    """Return the engine that fits hand models to key points.

    Args:
        rig: The cameras.
        hands: The models.
        detector: What finds the key points, as for `capture.fit.fit_hands`.

    Raises:
        ValueError: Fewer than two cameras, or one is wrong by itself.
    """
    if rig.num_views < 2:
        raise ValueError(f"a fit needs at least two views; the rig has {rig.num_views}")
    check_each_camera(rig)
    offsets = offsets_of(detector)
    fits = [_LiveHandFit(keypoint_model(hands.of(side), offsets), rig) for side in SIDES]

    def run(frames: Iterable[Frame]) -> Iterator[Frame]:
        for frame in frames:
            assert frame.keypoints_px is not None
            assert frame.confidence is not None
            assert frame.time_s is not None
            keypoints = ideal_keypoints(rig, frame.keypoints_px[None])[0]
            found = [
                fit.hand(frame.time_s, seen, confidence)
                for fit, seen, confidence in zip(fits, keypoints, frame.confidence, strict=True)
            ]
            yield frame._replace(hands=tuple(found))

    faces = {side: hands.of(side).faces for side in SIDES}
    return LiveEngine(run, fits[0].compile, faces, hands)


class _LiveHandFit:
    """One hand, moment by moment."""

    def __init__(self, model: KeypointModel, rig: Rig) -> None:
        self._model, self._rig, self._config = model, rig, fit_config(rig, smooth=False)
        self._kept: list[tuple[Array, Array]] = []
        """Key points and confidence of the moments that are to settle the shape."""
        self._kept_s = -np.inf
        self._shape: Array | None = None

    def compile(self) -> None:
        """Make the programs of an unknown shape and of a known one."""
        nothing = np.full((1, self._rig.num_views, NUM_JOINTS, 2), np.nan)
        for shape in (None, np.zeros(10, np.float32)):
            self._fit(nothing, np.ones(nothing.shape[:-1]), shape)

    def hand(
        self, time_s: float, keypoints: Float[Array, "view 21 2"], confidence: Float[Array, "view 21"]
    ) -> HandResult:
        """Fit a moment."""
        views = int(np.isfinite(keypoints).all(-1).any(-1).sum())
        if views < MIN_VIEWS:
            return HandResult(np.zeros(self._rig.num_views, bool), too_few_views(views, MIN_VIEWS))
        moment = keypoints[None], confidence[None]
        adds = len(self._kept) < MOMENTS_FOR_SHAPE and time_s - self._kept_s >= _APART_S
        anew = self._shape is None or (adds and len(self._kept) + 1 in _SETTLED_AT)
        together = [*self._kept, moment] if anew else [moment]
        seen, sure = (np.concatenate(arrays) for arrays in zip(*together, strict=True))
        fitted = self._fit(seen, sure, None if anew else self._shape)
        if adds and fitted.valid[-1]:
            self._kept.append(moment)
            self._kept_s = time_s
            if anew:
                self._shape = fitted.shape[-1]
        return fitted_hand(fitted, len(seen) - 1, joint_confidence(fitted, seen, sure, self._rig))

    def _fit(self, keypoints: Array, confidence: Array, shape: Array | None) -> "FitResult":
        size = MOMENTS_FOR_SHAPE if shape is None else 1
        # Single moments know no time.
        times = np.arange(len(keypoints), dtype=float)
        return fit_group(self._model, keypoints, confidence, times, self._rig, self._config, shape, size)


def live_network(rig: Rig, network: Network) -> LiveEngine:
    """Return the engine that looks at the images.

    Raises:
        ValueError: The network is for another number of cameras.
    """
    check_rig(network.config, rig)
    take = Take(rig, SIDES, ())
    unjudged = tuple(HandResult(np.zeros(rig.num_views, bool)) for _ in SIDES)

    def run(frames: Iterable[Frame]) -> Iterator[Frame]:
        for frame in frames:
            prepared = frame._replace(squares_px=hand_squares(frame, rig), hands=unjudged)
            crops = crop_hands([prepared], rig, network.config.crop, network.config.image_hw)
            yield from predict_hands(crops, take, network)

    def compile_programs() -> None:
        keypoints = np.empty((len(SIDES), rig.num_views, NUM_JOINTS, 2))
        spread = np.random.default_rng(0).uniform(-0.1, 0.1, (NUM_JOINTS, 2))
        keypoints[:] = rig.size_wh[:, None] * (0.5 + spread)
        images = tuple(np.full((height, width, 3), 128, np.uint8) for width, height in rig.size_wh)
        frame = Frame("", boxes_from_keypoints(keypoints), keypoints, images=images)
        for _ in run([frame]):
            pass

    return LiveEngine(run, compile_programs, network.faces(), network.hands())
