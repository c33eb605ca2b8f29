"""GLB and OBJ: what is written is what is read; files appear whole or not at all."""

import numpy as np
import pytest

from poem_jax.io.meshes import read_mesh, write_mesh


@pytest.fixture
def mesh():
    rng = np.random.default_rng(0)
    vertices = rng.uniform(-0.1, 0.1, (20, 3)).astype(np.float32)
    vertices[7] = vertices[3]  # a duplicate vertex must not be merged: MANO's numbering is the contract
    faces = np.array([[i, i + 1, i + 2] for i in range(18)], np.int32)
    return vertices, faces


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_round_trip(tmp_path, mesh, suffix):
    vertices, faces = mesh
    path = write_mesh(tmp_path / "new" / f"right{suffix}", vertices, faces)
    read_vertices, read_faces = read_mesh(path)
    np.testing.assert_allclose(read_vertices, vertices, atol=1e-8)
    np.testing.assert_array_equal(read_faces, faces)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_failed_write_leaves_the_old_file(tmp_path, mesh, suffix, monkeypatch):
    vertices, faces = mesh
    path = write_mesh(tmp_path / f"right{suffix}", vertices, faces)
    before = path.read_bytes()
    import trimesh

    def fails(self, file_obj, **kwargs):
        file_obj.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(trimesh.Trimesh, "export", fails)
    with pytest.raises(OSError, match="disk full"):
        write_mesh(path, vertices + 1, faces)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_errors(tmp_path, mesh):
    vertices, faces = mesh
    with pytest.raises(ValueError, match=r"must end in \.glb or \.obj; got 'hand\.stl'"):
        write_mesh(tmp_path / "hand.stl", vertices, faces)
    with pytest.raises(ValueError, match="must be finite"):
        write_mesh(tmp_path / "hand.obj", vertices * np.nan, faces)
    with pytest.raises(FileNotFoundError, match="no mesh file"):
        read_mesh(tmp_path / "none.obj")
    (tmp_path / "broken.glb").write_bytes(b"glTF?")
    with pytest.raises(ValueError, match="cannot be read as a mesh"):
        read_mesh(tmp_path / "broken.glb")
    assert not (tmp_path / "hand.obj").exists()
