"""Rows that measure nothing, and go wrong in every way, for a process that imports them by name."""

import os
import time
from dataclasses import dataclass
from enum import Enum

import jax

CPU = {
    "device": "cpu",
    "jax": "0",
    "backend": "cpu",
    "float32_peak_tflops": 5.0,
    "bfloat16_peak_tflops": None,
    "float32_product_tflops": 4.0,
    "bfloat16_product_tflops": 10.0,
}
"""The figures of a machine."""


class Ending(Enum):
    FINE = "fine"
    OUT_OF_MEMORY = "out of memory"
    DEATH = "death"
    HANGING = "hanging"


@dataclass(frozen=True)
class Planted:
    ending: Ending
    about_s: float = 0.0
    smaller: None = None

    @property
    def name(self) -> str:
        return self.ending.value

    def measure(self) -> dict:
        if self.ending is Ending.OUT_OF_MEMORY:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying\nto allocate")
        if self.ending is Ending.DEATH:
            os.abort()
        if self.ending is Ending.HANGING:
            time.sleep(600)
        return {"process": os.getpid()}
