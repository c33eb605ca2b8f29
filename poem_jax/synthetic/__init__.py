"""Endless synthetic multi-view captures with exact ground truth."""
