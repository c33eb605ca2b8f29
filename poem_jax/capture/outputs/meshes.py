"""`<frame>/<hand>.glb` and `.obj`: the meshes of each frame, in the capture's world."""

from collections.abc import Mapping
from pathlib import Path

from poem_jax.io.meshes import is_own_mesh, write_mesh
from poem_jax.typing import Array, Float, Int

MESH_SUFFIXES = (".glb", ".obj")


def write_frame_meshes(
    folder: Path, vertices: Mapping[str, Float[Array, "778 3"]], faces: Mapping[str, Int[Array, "face 3"]]
) -> list[Path]:
    """Write the meshes of a frame by the hands' names; return the files."""
    return [
        write_mesh(folder / f"{name}{suffix}", mesh, faces[name])
        for name, mesh in vertices.items()
        for suffix in MESH_SUFFIXES
    ]


def remove_own_meshes(folder: Path, hands: list[str]) -> None:
    """Remove the meshes that an earlier run left of hands that this one does not write."""
    for path in (folder / f"{name}{suffix}" for name in hands for suffix in MESH_SUFFIXES):
        if is_own_mesh(path):
            path.unlink()
