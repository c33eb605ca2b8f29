"""Takes with known hands: the shipped hand's joints in motion, as a detector with known faults sees them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from poem_jax.capture.association import AssociatedHands
from poem_jax.detection import DetectedHand
from poem_jax.geometry.cameras import project
from poem_jax.geometry.distortion import distort_pixels
from poem_jax.geometry.rig import Rig
from poem_jax.hand.model import hand_mesh, mirror_pose
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import FINGER_JOINTS, NUM_SHAPES, ROOT_JOINT
from poem_jax.synthetic.poses import sample_pose
from tests.rigs import look_at

FALSE = -1
"""True hand of a false detection."""
HAND_M = 0.18
NOISE = 0.025
"""Of one coordinate of a key point, in hands."""
RIGS = ("two", "four", "eight")
_LENS = np.array([-0.3, 0.05, -0.004, 0.004, 0.06])
_PLACES = {"right": np.array([0.12, 0.0, 0.0]), "left": np.array([-0.12, 0.0, 0.02])}


@dataclass
class Scene:
    """Detections, and the hand that each is of."""

    rig: Rig
    found: list[list[list[DetectedHand]]]
    truth: list[list[list[int]]]
    """Number of the true hand of each detection, or `FALSE`."""
    sides: tuple[str, ...]
    """Of the true hands."""
    max_hands: int = 2
    wanted: tuple[int, ...] | None = None
    """Hands that must come out whole; None = any, but each must be one hand."""
    warning: str | None = None
    """Words that a warning must hold."""


@dataclass
class Plan:
    """How hands move and how they are seen."""

    frames: int = 9
    sides: tuple[str, ...] = ("right", "left")
    offsets: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)))
    """Of each hand from its usual place, metres."""
    sway: float = 0.05
    cross: bool = False
    lens: float = 0.3
    """Share of a strong lens."""


def rig_of(name: str, lens: float) -> Rig:
    """Two cameras, a ring of four, or a half-dome of eight, a metre from the hands."""
    angles, heights = {
        "two": ([0.3, 1.5], [0.35, 0.5]),
        "four": (np.arange(4) * np.pi / 2 + 0.4, [0.3, 0.5, 0.3, 0.5]),
        "eight": (np.arange(8) * np.pi / 4, [0.2, 0.7] * 4),
    }[name]
    places = [np.array([np.cos(a), np.sin(a), h]) for a, h in zip(angles, heights, strict=True)]
    count = len(places)
    K = np.array([[900.0, 0, 640], [0, 905, 360], [0, 0, 1]]) + np.zeros((count, 1, 1))
    T = np.stack([look_at(place, np.zeros(3)) for place in places])
    sizes = np.array([[1280, 720]] * count)
    return Rig(tuple(f"cam_{i}" for i in range(count)), sizes, K, np.tile(lens * _LENS, (count, 1)), T)


def moving_joints(rng: np.random.Generator, plan: Plan) -> np.ndarray:
    """Joints (hand, frame, 21, 3) that sway, turn and bend."""
    t = np.arange(plan.frames) / 12
    hands = []
    for side, offset in zip(plan.sides, plan.offsets, strict=True):
        start, end = sample_pose(rng, 2)
        share = (0.5 - 0.5 * np.cos(3 * t))[:, None, None]
        pose = (1 - share) * start + share * end
        turn = rng.normal(0, 0.6, 3) + np.array([1.5, 0, 0]) + np.sin(t)[:, None] * rng.normal(0, 0.3, 3)
        pose = mirror_pose(pose) if side == "left" else pose
        pose[:, 0] = turn
        shape = np.broadcast_to(rng.normal(0, 0.7, NUM_SHAPES), (plan.frames, NUM_SHAPES))
        joints = np.asarray(hand_mesh(default_hand(side), pose, shape, center_joint=ROOT_JOINT).joints)
        phase, pace = rng.uniform(0, 6, 3), rng.uniform(1, 3, 3)
        place = _PLACES[side] + offset + plan.sway * np.sin(phase + pace * t[:, None])
        if plan.cross:
            x = np.linspace(1, -1, plan.frames) * (1 if side == "right" else -1)
            place[:, 0] = 0.15 * x
            place[:, 1:] = (0.03, 0.02) if side == "right" else (-0.03, -0.02)
        hands.append(joints + place[:, None])
    return np.stack(hands)


def seen_px(rng: np.random.Generator, rig: Rig, joints: np.ndarray, noise: float = NOISE) -> np.ndarray:
    """Raw pixels (hand, frame, view, 21, 2) with errors that joints of a view and frames share in part."""
    px, depth = project(rig.K, rig.T_cam_from_world, joints[..., None, :, :])
    sigma = noise * HAND_M * rig.K[:, 0, 0] / depth.mean(-1)
    shape = px.shape
    whole = rng.normal(0, 0.5, (*shape[:-2], 1, 2))
    lasting = rng.normal(0, 0.5, (shape[0], 1, *shape[2:]))
    own = rng.normal(0, 0.7, shape)
    own[..., [finger[-1] for finger in FINGER_JOINTS], :] *= 1.8
    ideal = px + sigma[..., None, None] * (whole + lasting + own)
    ideal = np.moveaxis(ideal, 2, 0)
    raw = distort_pixels(ideal.reshape(rig.num_views, -1, 2), rig.K, rig.dist)
    return np.moveaxis(raw.reshape(ideal.shape), 0, 2)


class Take:
    """A scene in the making: detections are added, taken away and spoiled."""

    def __init__(self, rng: np.random.Generator, rig_name: str, plan: Plan) -> None:
        self.rng, self.plan = rng, plan
        self.rig = rig_of(rig_name, plan.lens)
        self.joints = moving_joints(rng, plan)
        self.px = seen_px(rng, self.rig, self.joints)
        self.places = list(product(range(plan.frames), range(self.rig.num_views)))
        self.found: dict[tuple[int, int], list[tuple[int, DetectedHand]]] = {
            place: [] for place in self.places
        }
        for (frame, view), hand in product(self.places, range(len(plan.sides))):
            self.add(hand, frame, view, self.px[hand, frame, view], plan.sides[hand])

    def add(self, hand: int, frame: int, view: int, px: np.ndarray, side: str) -> None:
        score = self.rng.uniform(0.85, 0.999)
        self.found[frame, view].append((hand, DetectedHand(px, side, score, self.rng.uniform(0.6, 1))))

    def miss(self, hand: int, frames: Sequence[int], views: Sequence[int]) -> None:
        for place in product(frames, views):
            self.found[place] = [entry for entry in self.found[place] if entry[0] != hand]

    def miss_some(self, share: float, hands: Sequence[int]) -> None:
        for (frame, view), hand in product(self.places, hands):
            if self.rng.random() < share:
                self.miss(hand, [frame], [view])

    def wrong_side(self, hand: int, views: Sequence[int], share: float = 1.0) -> None:
        for frame, view in product(range(self.plan.frames), views):
            if self.rng.random() < share:
                self.found[frame, view] = [
                    (h, d._replace(side=other(d.side)) if h == hand else d)
                    for h, d in self.found[frame, view]
                ]

    def false_hand(self, frame: int, view: int) -> None:
        """Something anywhere in the image that looks like a hand of any size and side."""
        plan = Plan(1, (str(self.rng.choice(["right", "left"])),), self.rng.normal(0, 0.25, (1, 3)))
        px = seen_px(self.rng, self.rig, moving_joints(self.rng, plan))[0, 0, view]
        middle = px.mean(0)
        px = middle + self.rng.uniform(0.5, 1.3) * (px - middle)
        self.add(FALSE, frame, view, px, plan.sides[0])

    def second(self, hand: int, frame: int, view: int) -> None:
        """The same hand again, with errors of its own."""
        px = seen_px(self.rng, self.rig, self.joints[hand : hand + 1, frame : frame + 1], 0.03)[0, 0, view]
        self.add(hand, frame, view, px, str(self.rng.choice(["right", "left"])))

    def hide_behind(self) -> None:
        """Of two hands that cover each other in an image, the farther is not found."""
        for frame, view in self.places:
            a, b = self.px[:2, frame, view]
            if np.linalg.norm(a.mean(0) - b.mean(0)) < 0.25 * HAND_M * 900:
                camera = np.linalg.inv(self.rig.T_cam_from_world[view])[:3, 3]
                distances = np.linalg.norm(self.joints[:2, frame].mean(1) - camera, axis=-1)
                self.miss(int(distances.argmax()), [frame], [view])

    def at_most(self, count: int) -> None:
        """The detector stops at so many hands an image: the surest."""
        for place in self.places:
            self.found[place] = sorted(self.found[place], key=lambda entry: -entry[1].score)[:count]

    def scene(self, **settings) -> Scene:
        """Shuffle what was found in every image."""
        found, truth = [], []
        for frame in range(self.plan.frames):
            rows = [self.found[frame, view] for view in range(self.rig.num_views)]
            rows = [[row[i] for i in self.rng.permutation(len(row))] for row in rows]
            found.append([[detection for _, detection in row] for row in rows])
            truth.append([[hand for hand, _ in row] for row in rows])
        settings.setdefault("wanted", tuple(range(len(self.plan.sides))))
        return Scene(self.rig, found, truth, self.plan.sides, **settings)


def other(side: str) -> str:
    return "left" if side == "right" else "right"


def clean(rng, rig) -> Scene:
    take = Take(rng, rig, Plan())
    take.wrong_side(0, range(take.rig.num_views), 0.03)
    return take.scene()


def wrong_side_in_one_view(rng, rig) -> Scene:
    take = Take(rng, rig, Plan())
    take.wrong_side(int(rng.integers(2)), [int(rng.integers(take.rig.num_views))], 0.8)
    return take.scene()


def wrong_side_in_two_views(rng, rig) -> Scene:
    take = Take(rng, rig, Plan())
    views = rng.permutation(take.rig.num_views)[:2]
    take.wrong_side(int(rng.integers(2)), views.tolist(), 0.4 if rig != "eight" else 1.0)
    return take.scene()


def missed_views(rng, rig) -> Scene:
    take = Take(rng, rig, Plan())
    take.miss_some(0.25, (0, 1))
    return take.scene()


def false_in_one_view(rng, rig) -> Scene:
    take = Take(rng, rig, Plan())
    view = int(rng.integers(take.rig.num_views))
    for frame in range(0, take.plan.frames, 2):
        take.false_hand(frame, view)
    return take.scene()


def false_in_several_views(rng, rig) -> Scene:
    take = Take(rng, rig, Plan())
    for frame, view in take.places:
        if rng.random() < 0.4:
            take.false_hand(frame, view)
    return take.scene()


def seen_twice(rng, rig) -> Scene:
    take = Take(rng, rig, Plan())
    for frame, view in take.places:
        if rng.random() < 0.3:
            take.second(int(rng.integers(2)), frame, view)
    return take.scene()


def _two_people() -> Plan:
    second = np.array([0.05, 0.45, 0.05])
    return Plan(
        sides=("right", "left", "right", "left"), offsets=np.stack([[0, -0.15, 0]] * 2 + [second] * 2)
    )


def two_people_two_hands(rng, rig) -> Scene:
    take = Take(rng, rig, _two_people())
    take.miss_some(0.35, (2, 3))
    return take.scene(wanted=(0, 1), warning="--max-hands")


def two_people_two_found(rng, rig) -> Scene:
    take = Take(rng, rig, _two_people())
    take.at_most(2)
    return take.scene(wanted=None, warning="--max-hands")


def two_people_four_hands(rng, rig) -> Scene:
    take = Take(rng, rig, _two_people())
    take.miss_some(0.1, range(4))
    return take.scene(max_hands=4)


def crossing(rng, rig) -> Scene:
    take = Take(rng, rig, Plan(frames=20, cross=True, sway=0.0))
    take.wrong_side(0, range(take.rig.num_views), 0.1)
    take.hide_behind()
    return take.scene()


def leaves_and_returns(rng, rig) -> Scene:
    take = Take(rng, rig, Plan(frames=20, sway=0.1))
    views = range(take.rig.num_views)
    take.miss(0, range(6, 14), views)
    take.miss(1, range(10, 17), views)
    return take.scene()


def one_hand(rng, rig) -> Scene:
    take = Take(rng, rig, Plan(sides=(str(rng.choice(["right", "left"])),), offsets=np.zeros((1, 3))))
    take.wrong_side(0, range(take.rig.num_views), 0.1)
    return take.scene()


def one_view_for_a_while(rng, rig) -> Scene:
    take = Take(rng, rig, Plan(frames=14))
    hand, view = int(rng.integers(2)), int(rng.integers(take.rig.num_views))
    views = [v for v in range(take.rig.num_views) if v != view]
    take.miss(hand, range(5, 10), views)
    take.miss(1 - hand, range(0, 3), views)
    return take.scene()


def strong_lens(rng, rig) -> Scene:
    take = Take(rng, rig, Plan(lens=1.2, offsets=np.array([[0.15, 0.1, 0.1], [-0.15, -0.1, 0.0]])))
    return take.scene()


KINDS = (
    clean,
    wrong_side_in_one_view,
    wrong_side_in_two_views,
    missed_views,
    false_in_one_view,
    false_in_several_views,
    seen_twice,
    two_people_two_hands,
    two_people_two_found,
    two_people_four_hands,
    crossing,
    leaves_and_returns,
    one_hand,
    one_view_for_a_while,
    strong_lens,
)


def planted(kind, rig: str, seed: int) -> Scene:
    """The scene of a kind (one of `KINDS`) and a rig (one of `RIGS`)."""
    return kind(np.random.default_rng([KINDS.index(kind), RIGS.index(rig), seed]), rig)


def mistakes(scene: Scene, got: AssociatedHands) -> list[str]:
    """Everything in which a result differs from the truth."""
    told: list[str] = []
    owner: dict[int, set[int]] = {hand: set() for hand in range(len(got.hand_side))}
    missing = 0
    for frame, views in enumerate(scene.found):
        for view, found in enumerate(views):
            truth = scene.truth[frame][view]
            assigned = []
            for hand in owner:
                px = got.keypoints_px[frame, hand, view]
                if np.isfinite(px).any():
                    (number,) = (i for i, d in enumerate(found) if np.array_equal(d.keypoints_px, px))
                    assert got.score[frame, hand, view] == found[number].score
                    owner[hand].add(truth[number])
                    assigned.append(truth[number])
            wanted = {hand for hand in truth if hand in (scene.wanted or ())}
            missing += len(wanted - set(assigned))
    told += [f"hand {hand} is made of hands {sorted(of)}" for hand, of in owner.items() if len(of) != 1]
    told += [f"{missing} detections are missing"] * (missing > 0)
    first = [min(of) for of in owner.values() if of]
    told += ["one hand came out twice"] * (len(set(first)) < len(first))
    told += [
        f"hand {hand} is {scene.sides[true]}, not {side}"
        for hand, true, side in zip(owner, first, got.hand_side, strict=False)
        if true != FALSE and scene.sides[true] != side
    ]
    if scene.wanted is not None and set(first) != set(scene.wanted):
        told.append(f"hands {sorted(set(first))} came out, not {scene.wanted}")
    if scene.warning and not any(scene.warning in warning for warning in got.warnings):
        told.append(f"no warning says {scene.warning!r}")
    return told
