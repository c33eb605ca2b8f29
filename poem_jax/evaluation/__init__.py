"""Metrics, official protocols, baselines, the benchmark on synthetic captures, and tables.

Shapes: n samples, p points of a set; lengths are metres unless a name ends in `_mm`.
"""

from poem_jax.evaluation.metrics import evaluate
from poem_jax.evaluation.protocols import PROTOCOLS, Protocol, find_protocol

__all__ = ["PROTOCOLS", "Protocol", "evaluate", "find_protocol"]
