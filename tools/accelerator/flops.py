"""Floating-point operations of a function, counted in its jaxpr.

What compilers report leaves out library calls and counts a loop's body once. Only matrix products and
convolutions count, an addition and a multiplication each, as where a device's peak is stated.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn


def count_flops(function: Callable, *arguments: Any) -> int:
    """Return the operations of one call with these arguments, or with arrays of their shapes.

    Of the branches of a conditional the dearest counts; the body of a `while` loop counts once.
    """
    return _of_program(jax.make_jaxpr(function)(*arguments).jaxpr)


def _of_program(program: Jaxpr) -> int:
    return sum(_of_step(step) for step in program.eqns)


def _of_step(step: JaxprEqn) -> int:
    name, out = step.primitive.name, step.outvars[0].aval if step.outvars else None
    if name == "dot_general":
        ((contracted, _), _), left = step.params["dimension_numbers"], step.invars[0].aval
        return 2 * math.prod(out.shape) * math.prod(left.shape[axis] for axis in contracted)  # pyright: ignore
    if name == "conv_general_dilated":
        return _of_convolution(step)
    inner = [_of_program(program) for program in _programs_in(step)]
    if name == "cond":
        return max(inner, default=0)
    return sum(inner) * (step.params["length"] if name == "scan" else 1)


def _of_convolution(step: JaxprEqn) -> int:
    """Every output is a sum over the kernel's window and the input channels; zeros between the rows of a
    dilated image are not work."""
    kernel, out = step.invars[1].aval.shape, step.outvars[0].aval.shape  # pyright: ignore
    outputs = kernel[step.params["dimension_numbers"].rhs_spec[0]]
    work = 2 * math.prod(out) * math.prod(kernel) // outputs
    return work // (math.prod(step.params["lhs_dilation"]) * step.params["batch_group_count"])


def _programs_in(step: JaxprEqn) -> Iterator[Jaxpr]:
    for value in step.params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            if isinstance(one, ClosedJaxpr):
                yield one.jaxpr
            elif isinstance(one, Jaxpr):
                yield one
