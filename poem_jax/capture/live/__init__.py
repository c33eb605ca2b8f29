"""Hands while the cameras run: the newest moment in, its hands out, and nothing that waits in a queue."""
