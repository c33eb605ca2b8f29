"""The weight that a view's picture of a joint has: what the engines' confidences have in common."""

from poem_jax.typing import Array, Float

CUT_OFF_SIGMAS = 5.0
"""Where the robust kernel of the fit cuts off, too (`fitting.lm.LMConfig.robust_sigmas`)."""


def agreement(
    distance: Float[Array, "*batch"], sigma: Float[Array, "*#batch"] | float
) -> Float[Array, "*batch"]:
    """Return how well a point agrees with where it was expected, 0 to 1.

    The weight of Geman and McClure: 1 at the very place, 0.9 at 1.2 standard deviations (of one coordinate),
    which is the median distance of honest points, 0.5 at 3.2, 0.1 at 7.4.

    Args:
        distance: Of the two, in any unit.
        sigma: Standard deviation of one coordinate of the point, in the same unit.
    """
    return (1 + (distance / (CUT_OFF_SIGMAS * sigma)) ** 2) ** -2
