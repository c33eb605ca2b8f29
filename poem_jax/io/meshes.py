"""Triangle meshes as GLB and OBJ, through trimesh.

Vertices are written as they are: metres, in the frame they are given in (a capture's world frame, whatever
its axes), because a mesh that is laid over its calibration must not be turned to glTF's y-up habit.
"""

import os
from pathlib import Path

import numpy as np

from poem_jax.io.atomic import whole_file
from poem_jax.typing import Array, Float, Int

SKIN_RGB = (224, 172, 138)
GENERATOR = "poem_jax"
"""Stands in every mesh file that this package writes; see `is_own_mesh`."""
_WHERE_OURS_SAY_SO = 256
"""Bytes at the beginning of a file in which the generator is looked for."""


def write_mesh(
    path: str | os.PathLike,
    vertices: Float[Array, "vert 3"],
    faces: Int[Array, "face 3"],
    *,
    rgb: tuple[int, int, int] = SKIN_RGB,
) -> Path:
    """Write one mesh; the suffix of `path` chooses the format, and the file appears whole or not at all.

    Args:
        path: Ends in `.glb` (with smooth normals and a material) or `.obj`; both keep MANO's numbering.
        vertices: Metres, any frame; finite.
        faces: Vertex numbers from 0, counter-clockwise seen from outside.
        rgb: Colour of the GLB's material, 0 to 255.

    Raises:
        ValueError: Another suffix, or vertices that are not finite.
    """
    path = Path(path)
    if path.suffix not in (".glb", ".obj"):
        raise ValueError(f"a mesh file must end in .glb or .obj; got {path.name!r}")
    if not np.isfinite(vertices).all():
        raise ValueError(f"vertices of {path.name!r} must be finite; got NaN or infinity")
    mesh = _trimesh(vertices, faces, rgb)
    with whole_file(path) as temporary:
        if path.suffix == ".glb":
            mesh.export(temporary, file_type="glb", include_normals=True, tree_postprocessor=_sign)
        else:
            mesh.export(temporary, file_type="obj", digits=9, include_texture=False, header=GENERATOR)
    return path


def is_own_mesh(path: str | os.PathLike) -> bool:
    """Tell whether a file is a mesh that this package wrote, and nobody changed since with another tool."""
    path = Path(path)
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        start = stream.read(_WHERE_OURS_SAY_SO)
    return start.startswith(f"# {GENERATOR}".encode()) or f'"generator":"{GENERATOR}"'.encode() in start


def read_mesh(path: str | os.PathLike) -> tuple[Float[Array, "vert 3"], Int[Array, "face 3"]]:
    """Read vertices (float32) and faces (int32) of a one-mesh file, in the order they were written.

    Raises:
        FileNotFoundError: No such file.
        ValueError: The file holds no triangle mesh, or is damaged.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no mesh file at {path}")
    try:
        mesh = trimesh.load_mesh(path, process=False, maintain_order=True)
    except Exception as error:  # trimesh raises whatever its parsers meet
        raise ValueError(f"{path} cannot be read as a mesh: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"{path} must hold one triangle mesh; got {type(mesh).__name__} without faces")
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def _sign(tree: dict) -> None:
    tree["asset"]["generator"] = GENERATOR


def _trimesh(vertices: Array, faces: Array, rgb: tuple[int, int, int]):
    import trimesh
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    material = PBRMaterial(baseColorFactor=[*rgb, 255], metallicFactor=0.0, roughnessFactor=0.8)
    return trimesh.Trimesh(
        np.asarray(vertices, np.float64),
        np.asarray(faces),
        visual=TextureVisuals(material=material),
        process=False,
    )
