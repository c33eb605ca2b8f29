"""Samples and batches on the host, NumPy only."""
