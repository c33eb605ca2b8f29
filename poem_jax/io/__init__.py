"""Files: names, images, arrays, JSON, meshes, untrusted pickles; read within bounds, written whole."""
