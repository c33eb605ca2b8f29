"""Evaluate a model on synthetic captures: `python eval.py CONFIG [options]`.

CONFIG is an experiment file that defines `config = TrainConfig(...)`, as those in `configs/`; it names the
model and the distribution of captures. Prints the paper's columns by view count and a table that shows which
stage fails. Without --checkpoint the weights that come with the package are evaluated.

The joints of every column are the model's direct predictions, but with `--protocol poem-release`: that takes
them for AUC only, and joints regressed from the vertices of both sides for MPJPE, RR-J and PA-J, as POEM's
released evaluation does.
"""

import argparse
import dataclasses
import sys
import time

import jax
import numpy as np

from poem_jax.evaluation.benchmark import (
    DEFAULT_SEED,
    MAX_VIEWS,
    BenchmarkSettings,
    Scores,
    model_predictor,
    run_benchmark,
)
from poem_jax.evaluation.protocols import PROTOCOLS
from poem_jax.evaluation.tables import format_report, write_json
from poem_jax.hand.model import HandModel
from poem_jax.hand.template import default_hand
from poem_jax.io.compilation_cache import use_compilation_cache
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.synthetic.dataset import SyntheticDataset
from poem_jax.training.config import TrainConfig, load_experiment
from poem_jax.typing import Params
from poem_jax.weights.store import SHIPPED, load


def main(arguments: list[str]) -> int:
    """Run the command line; return the exit status."""
    options = parser().parse_args(arguments)
    try:
        results = run(options)
    except (ValueError, FileNotFoundError) as error:
        print(f"eval.py: {error}", file=sys.stderr)
        return 1
    if options.json is not None:
        write_json(options.json, results)
    return 0


def parser() -> argparse.ArgumentParser:
    """Build the command line."""
    parser = argparse.ArgumentParser(
        prog="eval.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("config_file", metavar="CONFIG")
    add("--checkpoint", metavar="DIR", help="a model that `poem_jax.save` or `train.py --export` wrote")
    add("--protocol", choices=PROTOCOLS, default="poem", help="whose definitions (default: poem)")
    add("--views", type=view_counts, default=(1, 2, 4, 8), metavar="N,N", help="default: 1,2,4,8")
    add("--seed", type=int, default=DEFAULT_SEED, help=f"of the captures (default: {DEFAULT_SEED})")
    add("--samples", type=int, default=200, help="captures (default: 200)")
    add("--batch-size", type=int, default=8, help="captures at a time (default: 8)")
    add("--json", metavar="FILE", help="write all metrics there, by view count")
    add("--no-progress", action="store_true")
    return parser


def view_counts(text: str) -> tuple[int, ...]:
    """Read `2,4,8`."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected view counts such as 2,4,8; got {text!r}") from None


def run(options: argparse.Namespace) -> dict[int, Scores]:
    """Evaluate and print."""
    settings = BenchmarkSettings(
        views=options.views,
        samples=options.samples,
        seed=options.seed,
        batch_size=options.batch_size,
        protocol=options.protocol,
        progress=not options.no_progress,
    )
    config = load_experiment(options.config_file)
    use_compilation_cache()
    weights = options.checkpoint or SHIPPED
    _, params = load(weights, expected=config.model)
    captures = SyntheticDataset(captures_config(config), seed=options.seed)
    started = time.perf_counter()
    hand = own_hand(params)
    results = run_benchmark(model_predictor(params, config.model), captures, settings, hand)
    seconds = time.perf_counter() - started
    seen = ", which is the TRAINING seed" if options.seed == config.data.seed else ""
    print(f"{config.name}: weights {weights}, protocol {options.protocol}")
    print(f"{options.samples} synthetic captures of seed {options.seed}{seen}; {seconds:.0f} s\n")
    regressed = PROTOCOLS[options.protocol].regresses_joints
    print(format_report(results, regressed_joints=regressed))
    return results


def own_hand(params: Params) -> HandModel:
    """Return the model's hand, which must be that of the captures.

    Raises:
        ValueError: it is another one (MANO, say), whose vertices mean other places.
    """
    hand = HandModel(**jax.device_get(params["constants"]["hand"]))
    if not np.allclose(hand.v_template, default_hand().v_template, atol=1e-6):
        raise ValueError(
            "synthetic captures show the hand of this package, and the model has another one, so that their "
            "vertices cannot be compared; evaluate a model that was trained with the package's hand"
        )
    return hand


def captures_config(config: TrainConfig) -> SyntheticConfig:
    """Return the experiment's distribution, with crops as the model wants them and all the views."""
    return dataclasses.replace(config.data.synthetic, image_hw=config.model.image_hw, num_views=MAX_VIEWS)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
