"""Names of a released stand-in, as PyTorch code would have saved it: `move` twice, the second time by another
name, beside a classifier that nothing reads."""

from poem_jax.weights.name_table import NameRow, NameRows, linear
from tests.stand_in import StandInConfig


def used_rows(config: StandInConfig) -> NameRows:
    """List the arrays that the forward pass uses."""
    yield from linear("head.move.0", "move")
    yield NameRow("head.running_mean", "statistics.norm_mean")


def aliases(config: StandInConfig) -> dict[str, str]:
    """Return the further names of arrays."""
    return {"head.move.1.weight": "head.move.0.weight"}


def unused_shapes(config: StandInConfig) -> dict[str, tuple[int, ...]]:
    """Return name and shape of what no output depends on, and of aliases."""
    return {"head.move.1.weight": (3, 3), "fc.weight": (10, 3), "head.num_batches_tracked": ()}


def hand_prefixes(config: StandInConfig) -> dict[str, bool]:
    """Return where the hand is."""
    return {"mano_layer.": False, "head.mano_layer.": True}
