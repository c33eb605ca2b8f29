"""Rigs, captures and the reconstruction pipeline."""
