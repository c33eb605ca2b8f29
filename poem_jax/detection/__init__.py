"""Hands in images: MediaPipe's two networks in JAX, and the way from their guesses to key points."""

from poem_jax.detection.detector import (
    DetectedHand,
    HandTracker,
    HandTrackers,
    compile_programs,
    find_hands,
)

__all__ = ["DetectedHand", "HandTracker", "HandTrackers", "compile_programs", "find_hands"]
