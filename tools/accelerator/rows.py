"""What can be measured: one class a kind of row, made where the time is kept and measured elsewhere.

A row crosses a pipe, so it holds plain values; JAX starts in `measure` alone.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

from poem_jax.models.config import Config
from poem_jax.training.config import ComputeConfig, Precision, Rematerialise, TrainConfig
from tools.accelerator.results import Figures


class Row(Protocol):
    """One line of the results."""

    @property
    def name(self) -> str:
        """What identifies it."""
        ...

    @property
    def about_s(self) -> float:
        """Seconds that it is guessed to take on a GPU, compiling included."""
        ...

    @property
    def smaller(self) -> "Row | None":
        """What is measured in its place where memory does not suffice; None = nothing."""
        ...

    def measure(self) -> Figures:
        """Measure it on the device that JAX has."""
        ...


@dataclass(frozen=True)
class Machine:
    """The device, and how fast it multiplies matrices: what other rows are compared with."""

    size: int
    """Rows and columns of the matrices."""
    name: str = "machine"
    about_s: float = 20.0
    smaller: None = None

    def measure(self) -> Figures:
        """Multiply random matrices in both number types."""
        import jax
        import jax.numpy as jnp

        from tools.accelerator.peaks import peak_tflops
        from tools.accelerator.timing import products_in, time_calls

        device = jax.devices()[0]
        figures: Figures = {
            "device": device.device_kind,
            "backend": jax.default_backend(),
            "jax": jax.__version__,
            "memory_gib": _memory_gib(device),
        }
        for precision in Precision:
            a = jax.random.normal(jax.random.key(0), (self.size, self.size)).astype(precision.value)
            product = jax.jit(lambda x: jnp.matmul(x, x))
            with products_in(precision):
                taken = time_calls(partial(product, a))
            figures[f"{precision.value}_product_tflops"] = 2e-12 * self.size**3 / taken.median_s
            figures[f"{precision.value}_peak_tflops"] = peak_tflops(device.device_kind)[precision.value]
        return figures


@dataclass(frozen=True)
class Inference:
    """A model on samples whose views are all there, jitted as a whole (`apply`) or as `infer` has it."""

    model_name: str
    model: Config
    precision: Precision
    views: int
    batch: int
    packed: bool = False
    """By `infer`, which takes the views from the host, in chunks."""
    about_s: float = 30.0

    @property
    def name(self) -> str:
        """What identifies it."""
        form = " by infer" if self.packed else ""
        return (
            f"inference {self.model_name} {self.precision.value} {self.views} views batch {self.batch}{form}"
        )

    @property
    def smaller(self) -> "Inference | None":
        """Half of the batch."""
        return replace(self, batch=self.batch // 2) if self.batch > 1 else None

    @property
    def labels(self) -> Figures:
        """What tells its figures from those of other rows."""
        return {
            "what": "inference",
            "model": self.model_name,
            "precision": self.precision.value,
            "views": self.views,
            "batch": self.batch,
            "packed": self.packed,
        }

    def measure(self) -> Figures:
        """Time calls on random images; the weights are fresh ones."""
        from tools.accelerator.inference import measure_inference
        from tools.accelerator.timing import products_in

        with products_in(self.precision):
            figures = measure_inference(
                self.model, self.precision, self.views, self.batch, packed=self.packed
            )
        return self.labels | figures


@dataclass(frozen=True)
class Training:
    """An experiment's step on a batch that lies on the device: value, gradients, optimiser."""

    model_name: str
    experiment: TrainConfig
    precision: Precision
    batch: int
    rematerialise: Rematerialise = Rematerialise.NOTHING
    about_s: float = 90.0

    @property
    def name(self) -> str:
        """What identifies it."""
        again = "" if self.rematerialise is Rematerialise.NOTHING else " rematerialised"
        return f"training {self.model_name} {self.precision.value} batch {self.batch}{again}"

    @property
    def smaller(self) -> "Training | None":
        """Half of the batch, and all computed again in the backward pass that can be."""
        if self.batch == 1:
            return None
        return replace(self, batch=self.batch // 2, rematerialise=Rematerialise.BOTH)

    @property
    def labels(self) -> Figures:
        """What tells its figures from those of other rows."""
        return {
            "what": "training",
            "model": self.model_name,
            "precision": self.precision.value,
            "batch": self.batch,
            "rematerialise": self.rematerialise.value,
        }

    def measure(self) -> Figures:
        """Time steps."""
        from tools.accelerator.timing import products_in
        from tools.accelerator.training import measure_training

        compute = ComputeConfig(precision=self.precision, rematerialise=self.rematerialise)
        with products_in(self.precision):
            figures = measure_training(replace(self.experiment, compute=compute), self.batch)
        return self.labels | figures


@dataclass(frozen=True)
class Fitting:
    """Hands fitted to a take of key points by Levenberg-Marquardt, all frames in one call."""

    frames: int
    views: int = 4
    about_s: float = 40.0
    smaller: None = None

    @property
    def name(self) -> str:
        """What identifies it."""
        return f"fitting {self.frames} frames {self.views} views"

    @property
    def labels(self) -> Figures:
        """What tells its figures from those of other rows."""
        return {"what": "fitting", "frames": self.frames, "views": self.views}

    def measure(self) -> Figures:
        """Time fits of a synthetic take with 2 px of noise."""
        import jax

        from poem_jax.fitting import Observations, fit_take, keypoint_model
        from poem_jax.hand.template import default_hand
        from poem_jax.synthetic.keypoint_takes import draw_keypoint_take
        from tools.accelerator.timing import products_in, time_calls

        hand = default_hand()
        take = draw_keypoint_take(hand, self.frames, self.views, 2.0, seed=1)
        seen = jax.device_put(Observations(take.uv_px, None, take.K, take.T_cam_from_world))
        fit = jax.jit(partial(fit_take, keypoint_model(hand)))
        with products_in(Precision.FLOAT32):
            taken = time_calls(lambda: fit(seen))
        return self.labels | {"fits_per_second": self.frames / taken.median_s, **taken.figures()}


def _memory_gib(device: Any) -> float | None:
    """Return what JAX may use of a device's memory, where the backend tells."""
    limit = (device.memory_stats() or {}).get("bytes_limit")
    return None if limit is None else round(limit / 2**30, 1)
