"""Cameras by a clock that only the test moves; a detector and an engine that know what the pictures show."""

import numpy as np

from poem_jax.calibration.epipolar import ideal_keypoints
from poem_jax.capture.frame import HandResult
from poem_jax.capture.live.engines import LiveEngine
from poem_jax.capture.live.newest import NewestShots, Shot
from poem_jax.data.lens import project_raw
from poem_jax.detection import DetectedHand
from poem_jax.geometry.triangulation import triangulate
from poem_jax.hand.model import hand_mesh
from poem_jax.hand.pair import hands_of
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_VERTICES
from tests.capture.planted_scenes import rig_of

RIG = rig_of("four", 0.3)
PERIOD_S = 1 / 30
SIDES = ("right", "left")
JOINTS = {
    side: np.asarray(hand_mesh(default_hand(side), np.zeros((16, 3)), np.zeros(10), center_joint=9).joints)
    for side in SIDES
}


def picture(number):
    """A picture that holds its number."""
    return np.full((2, 2, 3), number % 256, np.uint8)


class FakeShots(NewestShots):
    """Pictures come as they are planned while somebody waits or works; the clock stands still otherwise."""

    def __init__(self, num_views=RIG.num_views):
        self.now = 100.0
        super().__init__(num_views)
        self._plan = []

    def clock(self):
        return self.now

    def wait(self, seen, timeout_s):
        until = self.now + timeout_s
        self.work(max(min([until, *(at_s for at_s, _, _ in self._plan)]), self.now) - self.now)

    def work(self, seconds):
        """Let time go by."""
        until = self.now + seconds
        while self._plan and self._plan[0][0] <= until + 1e-9:
            at_s, view, shot = self._plan.pop(0)
            self.now = max(self.now, at_s)
            self.end(view) if shot is None else self.put(view, shot)
        self.now = until

    def plan(self, view, numbers, period_s=PERIOD_S, phase_s=0.0, late_s=0.0, ends=True):
        """Let a camera take pictures of these numbers, each `late_s` before it comes."""
        for number in numbers:
            time_s = self.begin_s + phase_s + number * period_s
            self._plan.append((time_s + late_s, view, Shot(number, time_s, picture(number))))
        if ends:
            self._plan.append((self.begin_s + (max(numbers) + 1) * period_s, view, None))
        self._plan.sort(key=lambda entry: entry[:2])


def true_joints(time_s):
    """A right and a left hand that sway, (hand, 21, 3)."""
    sway = 0.05 * np.array([np.sin(3 * time_s), np.cos(2 * time_s), 0.2])
    places = {"right": np.array([0.12, 0.0, 0.0]) + sway, "left": np.array([-0.12, 0.0, 0.02]) - sway}
    return np.stack([JOINTS[side] + place for side, place in places.items()])


def planted_detector(shots, work_s=0.0, sides=SIDES, asked=None):
    """What the pictures of a moment show, by their numbers; it takes its time."""

    def detect(views, images):
        numbers = [int(image[0, 0, 0]) for image in images]
        if asked is not None:
            asked.append((shots.now, dict(zip(views, numbers, strict=True))))
        shots.work(work_s)
        return [
            seen_hands(view, true_joints(n * PERIOD_S), sides) for view, n in zip(views, numbers, strict=True)
        ]

    return detect


def seen_hands(view, joints, sides=SIDES):
    pixels = [project_raw(RIG, view, hand)[0] for hand in joints]
    return [DetectedHand(px, side, 0.97, 0.9) for px, side in zip(pixels, sides, strict=True)]


def triangulated(frame):
    """The joints of a frame's hands by its key points; None = fewer than two views."""
    keypoints = ideal_keypoints(RIG, frame.keypoints_px[None])[0]
    found = [triangulate(hand, RIG.K, RIG.T_cam_from_world) for hand in keypoints]
    return [joints if valid.all() else None for joints, valid in found]


def fake_engine(shots=None, work_s=0.0):
    """Triangulates, without any program to compile."""
    hands = hands_of(default_hand())

    def run(frames):
        for frame in frames:
            if shots is not None:
                shots.work(work_s)
            yield frame._replace(hands=tuple(map(result, triangulated(frame))))

    faces = {side: hands.of(side).faces for side in SIDES}
    return LiveEngine(run, lambda: None, faces, None)


def result(joints):
    if joints is None:
        return HandResult(np.zeros(RIG.num_views, bool), "unseen")
    vertices = np.tile(joints, (40, 1))[:NUM_VERTICES]
    sigma = np.full(21, 0.001)
    return HandResult(np.ones(RIG.num_views, bool), None, vertices, joints, joints[9], joint_sigma_m=sigma)
