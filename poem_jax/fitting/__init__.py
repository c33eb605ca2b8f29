"""Hands fitted to 2D key points in calibrated views: robust triangulation, residuals, solvers."""
