"""Files: untrusted pickles and meshes."""
