"""Overlays and pages."""
