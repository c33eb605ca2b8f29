"""A first stage that several systems share: trunk and heat maps of a trained model, put into another."""

from poem_jax.models.network import is_of_first_stage
from poem_jax.typing import Params
from poem_jax.weights.store import flatten, unflatten


def with_first_stage(params: Params, of: Params, where: str) -> Params:
    """Return parameters whose trunk, and heat maps if there are any, are another model's.

    Args:
        params: of the model to be.
        of: the model that lends them.
        where: what errors call it.

    Raises:
        ValueError: the two have not the same trunk or heat maps; names what differs.
    """
    ours, theirs = flatten(params), flatten(of)
    wanted = [name for name in ours if is_of_first_stage(name)]
    for name in wanted:
        shape = theirs[name].shape if name in theirs else "nothing"
        if shape != ours[name].shape:
            raise ValueError(
                f"`train.first_stage_from`: {where} must have this model's trunk and heat maps; expected "
                f"{name} {ours[name].shape}, got {shape}"
            )
    if not wanted:
        raise ValueError("`train.first_stage_from` is for models with a trunk; this one has none")
    return unflatten({**ours, **{name: theirs[name] for name in wanted}}, params)
