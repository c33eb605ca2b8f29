"""`synthetic_benchmark`, which stands in poem_jax/experiments/."""

from poem_jax.experiments.synthetic_benchmark import benchmark as benchmark
