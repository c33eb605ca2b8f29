"""From a capture to hand meshes, as one line: read -> crop -> predict -> smooth -> judge ->
write.

Every stage is a function over a stream of frames (`frame.Frame`): it pulls one frame after the other from
the stage before it, fills in its own fields, and hands it on; the last stage writes. No stage looks back, how
many frames there are need not be known, and memory does not grow with them.
"""

import functools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from poem_jax.capture.agreement import judge_boxes
from poem_jax.capture.crop import crop_hands
from poem_jax.capture.fit import Hands, fit_hands, hands_of
from poem_jax.capture.frame import Frame
from poem_jax.capture.judge import judge_hands
from poem_jax.capture.network import Network, load_network, predict_hands
from poem_jax.capture.read import read_images
from poem_jax.capture.report import Clock
from poem_jax.capture.smoothing import OFF, Smoother, Smoothing
from poem_jax.capture.take import Take
from poem_jax.capture.write import Style, Written, write_results
from poem_jax.geometry.world_origin import distant_origin, move_origin
from poem_jax.hand.model import HandModel
from poem_jax.io.writable import check_folder_is_writable
from poem_jax.typing import Array, Int

Engine = Callable[[Iterable[Frame], Take, Clock], Iterator[Frame]]
"""What finds the hands: a stream of frames in, the stream with images and results out."""


def reconstruct(
    take: Take,
    out: str | os.PathLike,
    *,
    checkpoint: str | os.PathLike | None = None,
    network: Network | None = None,
    smoothing: Smoothing = OFF,
    meshes: bool | None = None,
    progress: bool = True,
) -> Written:
    """Reconstruct every hand of every frame by a network, and write what comes of it under `out`.

    Args:
        take: From `read_take`.
        out: Folder for the results; made when missing, files of the same name replaced.
        checkpoint: Model folder; None = the shipped weights. Not read when a network is given.
        network: A model in memory.
        smoothing: What is done to the hands of a take from frame to frame.
        meshes: Write the meshes of every frame; None = if there is only one.
        progress: Show a progress bar when there are several frames.

    Raises:
        FileNotFoundError, ValueError: The checkpoint, the rig, an image of the only frame, or all frames
            cannot be used; no hand is seen by two views; nothing can be written to `out`.
        KeyboardInterrupt: Ctrl-C, after what was done has been written.
    """
    check_folder_is_writable(out)
    clock = Clock()
    network = load_network(checkpoint) if network is None else network
    clock.lap("load_model")
    engine = functools.partial(by_network, network=network)
    about = {"engine": "network", "weights": network.origin, "image_hw": network.config.image_hw}
    smoother = Smoother(take, smoothing, network.hands())
    return _run(take, Path(out), engine, smoother, network.faces(), clock, about, meshes, progress)


def fit(
    take: Take,
    out: str | os.PathLike,
    *,
    hand: HandModel | None = None,
    smoothing: Smoothing = OFF,
    detector: str | None = None,
    meshes: bool | None = None,
    progress: bool = True,
) -> Written:
    """Fit every hand of a take to its key points, and write what `reconstruct` writes, under `out`.

    Beyond that `prediction.npz` holds `joint_sigma_m (F,H,21)`, the standard deviation of one coordinate of
    every joint, and `pose`, `shape` and `translation` of the hand model.

    Args:
        take: From `read_keypoint_take`, or from `read_take` where the boxes come with key points.
        out: Folder for the results.
        hand: The user's hand in MANO's schema, of either side; None = the shipped hand.
        smoothing: What is done to the hands of a take from frame to frame; offline adds a second pass of the
            fit that holds each hand's frames together.
        detector: What found the key points, as for `fit_hands`; None = as their file names it.
        meshes: Write the meshes of every frame; None = if there is only one.
        progress: Show a progress bar when there are several frames.

    Raises:
        FileNotFoundError, ValueError: No key points; fewer than two views; the rig does not fit the key
            points, or its unit is wrong; no hand can be fitted; nothing can be written to `out`.
        KeyboardInterrupt: Ctrl-C, after what was done has been written.
    """
    from poem_jax.hand.template import default_hand

    check_folder_is_writable(out)
    clock = Clock()
    hands = hands_of(default_hand() if hand is None else hand)
    second_pass = smoothing.mode == "offline"
    engine = functools.partial(by_fit, hands=hands, smooth=second_pass, detector=detector)
    about = {"engine": "fit", "hand": "shipped hand" if hand is None else "given"}
    about |= {"detector": take.detector if detector is None else detector}
    faces = {"right": hands.right.faces, "left": hands.left.faces}
    smoother = Smoother(take, smoothing, hands)
    return _run(take, Path(out), engine, smoother, faces, clock, about, meshes, progress)


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


def _run(
    take: Take,
    out: Path,
    engine: Engine,
    smoother: Smoother,
    faces: Mapping[str, Int[Array, "face 3"]],
    clock: Clock,
    about: Mapping[str, Any],
    meshes: bool | None,
    progress: bool,
) -> Written:
    """Run the line, in a world whose origin is near the cameras."""
    single = take.num_frames == 1
    origin_world = distant_origin(take.rig.T_cam_from_world)
    rig = take.rig._replace(T_cam_from_world=move_origin(take.rig.T_cam_from_world, origin_world))
    take = take._replace(rig=rig)
    frames = engine(take.frames, take, clock)
    frames = clock.timed("smooth", smoother.smooth(frames))
    frames = clock.timed("judge", judge_hands(frames, rig))
    frames = iter(tqdm(frames, total=take.num_frames, unit="frame", disable=single or not progress))
    style = Style(faces, single if meshes is None else meshes, not single, origin_world)
    return write_results(frames, take, out, style, clock, {**about, "smoothing": smoother.done})
