"""The engines that find hands in a capture, made ready to work, and which of them does.

Two exist: a network (`network.py`) looks at the images, a fit (`fit.py`) at 2D key points alone. Where both
can run and none was asked for, a few frames tell which to take (`engine_choice.py`).
"""

import functools
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from poem_jax.capture.agreement import judge_boxes
from poem_jax.capture.crop import crop_hands, hand_squares
from poem_jax.capture.engine_choice import EngineChoice, Find, choose_engine, sample_frames
from poem_jax.capture.fit import fit_hands, try_fit
from poem_jax.capture.frame import Frame, HandResult
from poem_jax.capture.network import Network, load_network, predict_hands
from poem_jax.capture.read import read_images
from poem_jax.capture.report import Clock
from poem_jax.capture.take import Take
from poem_jax.hand.model import HandModel
from poem_jax.hand.pair import Hands, hands_of
from poem_jax.typing import Array, Int

EngineName = Literal["auto", "fit", "poem"]

_log = logging.getLogger(__name__)


class Engine(NamedTuple):
    """What finds hands."""

    run: Callable[[Iterable[Frame], Take, Clock], Iterator[Frame]]
    """A stream of frames in, the stream with images and results out."""
    find: Find
    """The same on trial: nothing is judged, and no image read that it does not need."""
    faces: Mapping[str, Int[Array, "face 3"]]
    """Triangles by side."""
    hands: Hands | None
    """The hand models that its meshes are of; None = not known."""
    about: Mapping[str, Any]
    """What the report says of it."""


class EngineOptions(NamedTuple):
    """What the engines are made of, as far as the user says; each looks at its own part."""

    checkpoint: str | os.PathLike | None = None
    network: Network | None = None
    hand: HandModel | None = None
    second_pass: bool = False
    """Whether the fit holds each hand's frames together."""
    detector: str | None = None


class Chosen(NamedTuple):
    """An engine that was asked for or found best."""

    engine: Engine
    choice: EngineChoice
    take: Take
    """The take to work on: the one that was given, whole."""


def engine_for(take: Take, name: EngineName | str, options: EngineOptions) -> Chosen:
    """Make the engine of a name ready; "auto" looks which of them can run, and tries both if both can.

    Raises:
        FileNotFoundError, ValueError: The name, the checkpoint or the hand cannot be used; in a trial, what
            ends a reconstruction, too.
    """
    makers = {
        "fit": functools.partial(fit_engine, take, options),
        "poem": functools.partial(network_engine, options),
    }
    _check_options(name, options)
    if name in makers:
        return Chosen(makers[name](), EngineChoice(name, "as asked", "it was asked for"), take)
    sample, take = sample_frames(take)
    choice = _only_one(sample.keypoints, sample.images, bool(sample.frames))
    if choice is None:
        engines = {each: make() for each, make in makers.items()}
        choice = choose_engine(take, sample.frames, {each: made.find for each, made in engines.items()})
        engine = engines[choice.engine]
    else:
        engine = makers[choice.engine]()
    _log.info("engine: %s, by %s: %s", choice.engine, choice.by, choice.why)
    _warn_of_unused(choice.engine, options)
    return Chosen(engine, choice, take)


def _check_options(name: EngineName | str, options: EngineOptions) -> None:
    if name not in get_args(EngineName):
        raise ValueError(f"`engine` must be one of {', '.join(get_args(EngineName))}; got {name!r}")
    if name == "fit" and (options.checkpoint is not None or options.network is not None):
        raise ValueError("`checkpoint` and `network` are for the engine poem; a fit has no weights")
    if name == "poem" and (options.hand is not None or options.detector is not None):
        raise ValueError("`hand` and `detector` are for the engine fit; poem has its own hand")


def _warn_of_unused(taken: str, options: EngineOptions) -> None:
    """Say which options the engine that was taken makes no use of."""
    of_poem = {"checkpoint": options.checkpoint, "network": options.network}
    of_fit = {"hand (--mano)": options.hand, "detector": options.detector}
    unused = [name for name, value in (of_poem if taken == "fit" else of_fit).items() if value is not None]
    if unused:
        _log.warning(
            "the engine is %s, which makes no use of %s; ask for the other one by --engine",
            *(taken, " and ".join(unused)),
        )


def _only_one(keypoints: bool, images: bool, anything: bool) -> EngineChoice | None:
    """Return the engine that there is no choice about, None where both can be tried."""
    by = "only one can run"
    if not keypoints:
        return EngineChoice("poem", by, "there are boxes only, and the fit needs key points")
    if not images:
        return EngineChoice("fit", by, "there are no images for the network to look at")
    if not anything:
        why = "no hand is seen by two views in the frames that were looked through; the fit takes less time"
        return EngineChoice("fit", "nothing to compare", why)
    return None


def network_engine(options: EngineOptions) -> Engine:
    """Load the network.

    Raises: FileNotFoundError, ValueError: As `load_network`.
    """
    network = load_network(options.checkpoint) if options.network is None else options.network
    about = {"weights": network.origin, "image_hw": network.config.image_hw}
    about |= {"uncertainty": f"{'' if network.trust.calibrated else 'not '}calibrated with these weights"}
    run, find = (functools.partial(stage, network=network) for stage in (by_network, try_network))
    return Engine(run, find, network.faces(), network.hands(), about)


def fit_engine(take: Take, options: EngineOptions) -> Engine:
    """Prepare the hands to fit."""
    from poem_jax.hand.template import default_hand

    hands = hands_of(default_hand() if options.hand is None else options.hand)
    detector = options.detector
    about = {"hand": "shipped hand" if options.hand is None else "given"}
    about |= {"detector": take.detector if detector is None else detector}
    faces = {"right": hands.right.faces, "left": hands.left.faces}
    run = functools.partial(by_fit, hands=hands, smooth=options.second_pass, detector=detector)
    find = functools.partial(try_fit, hands=hands, detector=detector)
    return Engine(run, find, faces, hands, about)


def by_network(frames: Iterable[Frame], take: Take, clock: Clock, network: Network) -> Iterator[Frame]:
    """Find hands in images: boxes that do not fit together are marked before any image is read."""
    config = network.config
    frames = clock.timed("judge_boxes", judge_boxes(frames, take.rig))
    frames = clock.timed("read", read_images(frames, take.rig, go_on=take.num_frames != 1))
    frames = clock.timed("crop", crop_hands(frames, take.rig, config.crop, config.image_hw))
    return clock.timed("predict", predict_hands(frames, take, network))


def by_fit(
    frames: Iterable[Frame], take: Take, clock: Clock, hands: Hands, smooth: bool, detector: str | None
) -> Iterator[Frame]:
    """Find hands from key points; images are read afterwards, to be drawn on."""
    frames = clock.timed("predict", fit_hands(frames, take, hands, smooth=smooth, detector=detector))
    return clock.timed("read", read_images(frames, take.rig, needed=False))


def try_network(frames: Iterable[Frame], take: Take, network: Network) -> Iterator[Frame]:
    """Find hands in the images of a few frames; a lost image costs its view, and boxes are not judged."""
    unjudged = tuple(HandResult(np.zeros(take.rig.num_views, bool)) for _ in take.hand_sides)
    frames = (frame._replace(squares_px=hand_squares(frame, take.rig), hands=unjudged) for frame in frames)
    frames = read_images(frames, take.rig)
    frames = crop_hands(frames, take.rig, network.config.crop, network.config.image_hw)
    return predict_hands(frames, take, network)
