"""Which files are written beyond those that always are."""

import enum


class Format(enum.StrEnum):
    """Kinds of files that can be chosen."""

    GLB = "glb"
    """`hands.glb`, an animation of a take."""
    BVH = "bvh"
    """`<hand>.bvh`, the moving skeleton of each hand."""
    CSV = "csv"
    """`joints.csv` and `joint_angles.csv`."""
    TRC = "trc"
    """`hands.trc`, the joints as markers."""
    MANO = "mano"
    """`mano.npz`, the hand model's parameters."""
    VIDEO = "video"
    """Overlays as one video a camera, however short the take."""
    PNG = "png"
    """Overlays as one image a frame and camera, however long the take."""
    CAPTURE = "capture"
    """`capture/`, the take as a labelled capture to train a model on."""


DEFAULT_FORMATS = frozenset({Format.GLB})


def formats_of(text: str) -> frozenset[Format]:
    """Read a list such as `glb,bvh,csv`.

    Raises: ValueError: A name is not that of a format.
    """
    names = [name.strip().lower() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in set(Format)]
    if unknown or not names:
        raise ValueError(
            f"--formats must be a list of {', '.join(Format)}, with commas between; got {text!r}"
            + (f", of which {', '.join(map(repr, unknown))} is none of these" if unknown else "")
        )
    return frozenset(Format(name) for name in names)
