"""The `.dat` files of TemugeB's stereo calibration (bodypose3d, handpose3d): two for each camera of a folder.

    c0.dat:             intrinsic: three rows of K, distortion: k1 k2 p1 p2 k3
    rot_trans_c0.dat:   R: three rows, T: three numbers; what follows a `#` is not read

x_cam = R @ x_world + T, pixels from the centre of the first, lengths in squares of the board or centimetres.
The size of the images is not in the files.
"""

import re
from collections.abc import Sequence

from poem_jax.calibration.assemble import Calibration, FileCamera, from_centres, pose
from poem_jax.calibration.camera_values import intrinsics, rotation, short, translation
from poem_jax.calibration.documents import Document, Syntax, is_number
from poem_jax.calibration.lens_values import lens_terms

_PLACE = "rot_trans_"


def is_stereo_dat(document: Document) -> bool:
    """Tell whether a file is of this kind, whole or broken."""
    return document.syntax is Syntax.LINES and ({"intrinsic"} <= document.keys or {"R", "T"} <= document.keys)


def read_stereo_dat(documents: Sequence[Document]) -> Calibration:
    """Read the files of all cameras of a folder.

    Raises: ValueError: one is broken, or a camera has one of the two alone.
    """
    by_stem = {document.path.stem: document for document in documents}
    names = sorted(stem for stem in by_stem if not stem.startswith(_PLACE))
    lonely = [
        stem for stem in by_stem if stem.startswith(_PLACE) and stem.removeprefix(_PLACE) not in by_stem
    ]
    path = documents[0].path
    if lonely:
        raise ValueError(
            f"{path.parent}: {lonely[0]}.dat has no {lonely[0].removeprefix(_PLACE)}.dat beside it"
        )
    cameras = []
    for name in names:
        if _PLACE + name not in by_stem:
            raise ValueError(
                f"{path.parent}: {name}.dat, a camera's lens, has no {_PLACE}{name}.dat beside it, its place"
            )
        lens, place = _sections(by_stem[name]), _sections(by_stem[_PLACE + name])
        where = f"{path.parent}: camera '{name}'"
        K = from_centres(intrinsics(_rows(lens, "intrinsic", where), where))
        dist = lens_terms(_rows(lens, "distortion", where)[0], f"{where}: `distortion`")
        R = rotation(_rows(place, "R", where), where)
        t = translation(_rows(place, "T", where), where)
        cameras.append(FileCamera(name, None, K, dist, pose(R, t)))
    return Calibration(cameras, customs=("centimetre", "metre"))


def _sections(document: Document) -> dict[str, list[list[float]]]:
    """Return the rows of numbers under each line that ends with a colon, up to a comment."""
    sections: dict[str, list[list[float]]] = {}
    current = None
    for line in document.text.splitlines():
        if line.lstrip().startswith("#"):
            break
        heading = re.fullmatch(r"\s*(\w+):\s*", line)
        if heading:
            current = sections.setdefault(heading[1], [])
            continue
        words = line.split()
        if words and (current is None or not all(map(is_number, words))):
            raise ValueError(
                f"{document.path}: a line must be a heading, R: for instance, or numbers; got {short(line)}"
            )
        if words and current is not None:
            current.append([float(word) for word in words])
    return sections


def _rows(sections: dict[str, list[list[float]]], key: str, where: str) -> list[list[float]]:
    if not sections.get(key):
        raise ValueError(f"{where}: `{key}:` is missing; found {', '.join(sections) or 'nothing'}")
    return sections[key]
