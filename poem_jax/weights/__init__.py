"""Saving, loading and importing parameters."""
