"""What `--source` may be: cameras by name, videos by camera, or the folder of a take."""

from collections.abc import Sequence
from pathlib import Path

from poem_jax.capture.live.cameras import Cameras
from poem_jax.capture.live.playback import Playback
from poem_jax.capture.moments import Moments, find_moments
from poem_jax.capture.video_moments import VideoMoments, open_clips
from poem_jax.geometry.rig import Rig
from poem_jax.io.file_names import name_key
from poem_jax.io.video import VIDEO_SUFFIXES

Source = Cameras | Playback
"""Cameras that run, or seem to: `start` lets them, `close` ends them."""


def open_source(texts: Sequence[str], rig: Rig, *, loop: bool = False) -> Source:
    """Open what the options name.

    Args:
        texts: A folder, or `CAMERA=WHAT` for some of the rig's cameras: the number of a device, a URL, or a
            video file, the same kind for all.
        rig: The cameras.
        loop: Play a take again and again.

    Raises:
        FileNotFoundError, ValueError: A source cannot be read as such, names no camera of the rig, or one
            twice; or fewer than two cameras have one.
        ConnectionError: A camera cannot be opened.
    """
    if len(texts) == 1 and ("=" not in texts[0] or Path(texts[0]).is_dir()):
        return Playback(find_moments(texts[0], rig), rig, loop=loop)
    addresses = _addresses(texts, rig)
    videos = {name: Path(what) for name, what in addresses.items() if _is_video_file(what)}
    if videos and len(videos) < len(addresses):
        camera = next(name for name in addresses if name not in videos)
        raise ValueError(
            f"--source must name cameras alone or video files alone; {next(iter(videos))} is a file and "
            f"{camera} is not"
        )
    if videos:
        frames = VideoMoments(open_clips(videos, rig.names, {}, {}), rig.num_views)
        return Playback(Moments(frames, frames.frames_per_second, True), rig, loop=loop)
    if loop:
        raise ValueError("--loop is for a take or videos; cameras have no end to begin again from")
    return Cameras(addresses, rig)


def _addresses(texts: Sequence[str], rig: Rig) -> dict[str, str]:
    """Return what is named for each camera, by the camera's name in the rig."""
    known = {name_key(name): name for name in rig.names}
    addresses: dict[str, str] = {}
    for text in texts:
        name, equals, what = text.partition("=")
        if not equals or not what:
            raise ValueError(
                f"--source must be a folder alone, or {rig.names[0]}=WHAT for each camera (the number of a "
                f"device, a URL, or a video); got {text!r}"
            )
        if name_key(name) not in known:
            raise ValueError(
                f"--source: there is no camera {name!r} in the rig; it has {', '.join(rig.names)}"
            )
        camera = known[name_key(name)]
        if camera in addresses:
            raise ValueError(f"--source names camera '{camera}' twice")
        addresses[camera] = what
    if len(addresses) < 2:
        raise ValueError(
            f"--source must give two cameras of {', '.join(rig.names)} or more: got {len(addresses)}"
        )
    if len(set(addresses.values())) < len(addresses):
        raise ValueError("--source gives two cameras the same source: each has its own")
    return addresses


def _is_video_file(what: str) -> bool:
    return "://" not in what and Path(what).suffix.lower() in VIDEO_SUFFIXES
