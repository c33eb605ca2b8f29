"""From a capture to hand meshes, as one line: read -> crop -> predict -> smooth -> judge ->
write.

Every stage is a function over a stream of frames (`frame.Frame`): it pulls one frame after the other from
the stage before it, fills in its own fields, and hands it on; the last stage writes. No stage looks back, how
many frames there are need not be known, and memory does not grow with them.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from poem_jax.capture.engines import EngineName, EngineOptions, engine_for
from poem_jax.capture.judge import judge_hands
from poem_jax.capture.network import Network
from poem_jax.capture.outputs.formats import DEFAULT_FORMATS, Format
from poem_jax.capture.report import Clock
from poem_jax.capture.smoothing import OFF, Smoother, Smoothing
from poem_jax.capture.take import Take
from poem_jax.capture.write import Style, Written, write_results
from poem_jax.geometry.world_origin import distant_origin, move_origin
from poem_jax.hand.model import HandModel
from poem_jax.io.writable import check_folder_is_writable


def reconstruct(
    take: Take,
    out: str | os.PathLike,
    *,
    engine: EngineName | str = "auto",
    checkpoint: str | os.PathLike | None = None,
    network: Network | None = None,
    hand: HandModel | None = None,
    detector: str | None = None,
    smoothing: Smoothing = OFF,
    meshes: bool | None = None,
    formats: frozenset[Format] = DEFAULT_FORMATS,
    progress: bool = True,
) -> Written:
    """Reconstruct every hand of every frame, and write what comes of it under `out`.

    `prediction.npz` holds `joint_sigma_m (F,H,21)`, the standard deviation of one coordinate of every joint;
    of the fit and of parametric networks also `pose`, `shape` and `translation` of the hand model.

    Args:
        take: From `read_take` or `read_keypoint_take`.
        out: Folder for the results; made when missing, files of the same name replaced.
        engine: "poem": a network looks at the images; "fit": a hand model is fitted to the key points;
            "auto": whichever can run, and if both can, the one that is nearer to the key points of views that
            neither was given (`engine_choice`).
        checkpoint: Of poem: model folder; None = the shipped weights. Not read when a network is given.
        network: Of poem: a model in memory.
        hand: Of the fit: the user's hand in MANO's schema, of either side; None = the shipped hand.
        detector: Of the fit: what found the key points, as for `fit_hands`; None = as their file names it.
        smoothing: What is done to the hands of a take from frame to frame; offline adds a second pass of the
            fit that holds each hand's frames together.
        meshes: Write the meshes of every frame; None = if there is only one.
        formats: What to write beyond arrays, page, report and overlays.
        progress: Show a progress bar when there are several frames.

    Raises:
        FileNotFoundError, ValueError: The checkpoint, the rig, an image of the only frame, or all frames
            cannot be used; for a fit: no key points, or they do not fit the rig; no hand is seen by two
            views; nothing can be written to `out`.
        KeyboardInterrupt: Ctrl-C, after what was done has been written.
    """
    check_folder_is_writable(out)
    clock = Clock()
    single = take.num_frames == 1
    # A world whose origin is near the cameras.
    origin_world = distant_origin(take.rig.T_cam_from_world)
    rig = take.rig._replace(T_cam_from_world=move_origin(take.rig.T_cam_from_world, origin_world))
    options = EngineOptions(checkpoint, network, hand, smoothing.mode == "offline", detector)
    chosen = engine_for(take._replace(rig=rig), engine, options)
    clock.lap("choose_engine" if chosen.choice.figures else "load_model")
    take = chosen.take
    frames = chosen.engine.run(take.frames, take, clock)
    smoothed: Mapping[str, Any] = {"mode": smoothing.mode}
    if smoothing.mode != "off":
        smoother = Smoother(take, smoothing, chosen.engine.hands)
        frames, smoothed = clock.timed("smooth", smoother.smooth(frames)), smoother.done
    frames = clock.timed("judge", judge_hands(frames, rig))
    frames = iter(tqdm(frames, total=take.num_frames, unit="frame", disable=single or not progress))
    meshes = single if meshes is None else meshes
    sides = chosen.engine.hands and chosen.engine.hands.by_side()
    style = Style(chosen.engine.faces, meshes, not single, origin_world, sides, formats)
    about = {"engine": chosen.choice.engine, **chosen.engine.about}
    about |= {"engine_choice": chosen.choice.as_report(), "smoothing": smoothed}
    return write_results(frames, take, Path(out), style, clock, about)


def fit(
    take: Take,
    out: str | os.PathLike,
    *,
    hand: HandModel | None = None,
    smoothing: Smoothing = OFF,
    detector: str | None = None,
    meshes: bool | None = None,
    formats: frozenset[Format] = DEFAULT_FORMATS,
    progress: bool = True,
) -> Written:
    """Fit every hand of a take to its key points: `reconstruct` by the engine "fit".

    Args and errors: as `reconstruct`.
    """
    return reconstruct(
        take,
        out,
        engine="fit",
        hand=hand,
        smoothing=smoothing,
        detector=detector,
        meshes=meshes,
        formats=formats,
        progress=progress,
    )
