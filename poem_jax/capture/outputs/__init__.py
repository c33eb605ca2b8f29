"""What a reconstruction leaves on disk, one file a kind of output; `capture/write.py` puts them together."""
