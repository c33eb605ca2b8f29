"""Differentiable multi-view geometry: pure functions over any leading batch axes."""
