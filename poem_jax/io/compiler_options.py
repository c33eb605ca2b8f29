"""What the compiler is told about programs that run on a CPU."""

import functools
from typing import Any

_ONE_THREAD = ("xla_cpu_multi_thread_eigen", False)
_WIDE = ("xla_cpu_prefer_vector_width", "512")
"""By default XLA uses half of what AVX-512 has: 3 % slower on whole models, 12 % on the hand detector. Of no
effect on machines without."""
_NO_YNN = ("xla_cpu_experimental_ynn_fusion_type", "")
"""YNNPACK's fusions, on by default in jaxlib 0.10, are slower on convolutional networks (1.2 times the time
for whole models, 1.5 times for the hand detector) and use all cores whatever a program was told."""


def cpu_options(*, one_thread: bool) -> dict[str, Any]:
    """Return JAX's `compiler_options` for a program of inference on a CPU.

    Args:
        one_thread: several such programs are to run side by side.
    """
    wanted = (_ONE_THREAD, _WIDE, _NO_YNN) if one_thread else (_WIDE, _NO_YNN)
    return dict(option for option in wanted if _is_known(*option))


@functools.cache
def _is_known(name: str, value: Any) -> bool:
    """Tell whether this jaxlib has an option: they come and go."""
    import jax

    try:
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True
