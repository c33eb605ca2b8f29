"""`poem eval`."""

import dataclasses
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from poem_jax.cli.messages import say
from poem_jax.cli.options import Experiment, Flag, OptionalFile, OptionalFolder

if TYPE_CHECKING:
    from poem_jax.hand.model import HandModel
    from poem_jax.models.config import ModelConfig
    from poem_jax.synthetic.config import SyntheticConfig
    from poem_jax.synthetic.dataset import SyntheticDataset
    from poem_jax.training.config import TrainConfig
    from poem_jax.typing import Params


@dataclass(frozen=True)
class Eval:
    """Evaluate a model on synthetic captures: the paper's columns by view count, and which stage fails.

    The joints of every column are the model's direct predictions. Only --protocol poem-release takes them for
    AUC alone, and joints regressed from the vertices of both sides for MPJPE, RR-J and PA-J, as POEM's
    released evaluation does.
    """

    experiment: Experiment
    """An experiment of the package, such as tiny_synthetic, or a Python file that defines `config`; it names
    the model and the distribution of captures."""
    checkpoint: OptionalFolder = None
    """Model folder that poem_jax.save or `poem train --export` wrote; without it the shipped weights."""
    protocol: Literal["poem", "poem-release", "freihand", "ho3d", "dexycb"] = "poem"
    """Whose definitions."""
    views: Annotated[str, tyro.conf.arg(metavar="N,N")] = "1,2,4,8"
    """View counts."""
    seed: int = 20261122
    """Of the captures."""
    samples: int = 200
    """Captures."""
    batch_size: int = 8
    """Captures at a time."""
    json: OptionalFile = None
    """Write all metrics there, by view count."""
    stages: Flag = False
    """Print, too, which stage does the work: errors after each layer, and with features, root or joints
    replaced (for 2 views or more, on whole batches of captures; not in the JSON file)."""
    no_progress: Flag = False
    """Show no progress bar."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Evaluate, print the tables, and write the file."""
        from poem_jax.evaluation.benchmark import BenchmarkSettings, model_predictor, run_benchmark
        from poem_jax.evaluation.protocols import PROTOCOLS
        from poem_jax.evaluation.stages import check_has_stages
        from poem_jax.evaluation.tables import format_report, write_json
        from poem_jax.experiments import open_experiment
        from poem_jax.io.writable import check_file_is_writable
        from poem_jax.synthetic.dataset import SyntheticDataset
        from poem_jax.weights.store import SHIPPED, load

        if self.json is not None:
            check_file_is_writable(self.json, "--json")
        if self.stages and (
            max(view_counts(self.views)) < 2 or self.batch_size < 2 or self.samples < self.batch_size
        ):
            raise ValueError(
                "--stages needs a view count of 2 or more, and --samples of at least one batch of 2 or more; "
                f"got --views {self.views}, --samples {self.samples}, --batch-size {self.batch_size}"
            )
        settings = BenchmarkSettings(
            views=view_counts(self.views),
            samples=self.samples,
            seed=self.seed,
            batch_size=self.batch_size,
            protocol=self.protocol,
            progress=not self.no_progress,
        )
        config = open_experiment(self.experiment)
        if self.stages:
            check_has_stages(config.model)
        captures = SyntheticDataset(captures_config(config), seed=self.seed)
        weights = self.checkpoint or SHIPPED
        _, params = load(weights, expected=config.model)
        hand = hand_of_captures(params)
        say(f"{self.samples} captures; every view count compiles a program, once on this machine")
        start = time.perf_counter()
        results = run_benchmark(model_predictor(params, config.model), captures, settings, hand)
        seconds = time.perf_counter() - start
        if self.json is not None:
            write_json(self.json, results)
        seen = ", which is the TRAINING seed" if self.seed == config.data.seed else ""
        print(f"{config.name}: weights {weights}, protocol {self.protocol}")
        print(f"{self.samples} synthetic captures of seed {self.seed}{seen}; {seconds:.0f} s\n")
        print(format_report(results, regressed_joints=PROTOCOLS[self.protocol].regresses_joints))
        if self.stages:
            self._print_stages(params, config.model, captures)

    def _print_stages(self, params: "Params", model: "ModelConfig", captures: "SyntheticDataset") -> None:
        from poem_jax.evaluation.stages import format_stages, stage_errors

        samples, size = self.samples - self.samples % self.batch_size, self.batch_size
        say(f"{samples} captures again, each part of the model replaced in turn")
        print()
        print(
            format_stages(
                {
                    views: stage_errors(
                        params, model, captures, samples=samples, num_views=views, batch_size=size
                    )
                    for views in view_counts(self.views)
                    if views > 1
                }
            )
        )


def view_counts(text: str) -> tuple[int, ...]:
    """Read `2,4,8`."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--views: expected view counts such as 2,4,8; got {text!r}") from None


def hand_of_captures(params: "Params") -> "HandModel":
    """Return the model's hand, which must be that of the captures.

    Raises:
        ValueError: It is another one (MANO, say), whose vertices mean other places.
    """
    import jax
    import numpy as np

    from poem_jax.hand.model import HandModel
    from poem_jax.hand.template import default_hand

    hand = HandModel(**jax.device_get(params["constants"]["hand"]))
    if not np.allclose(hand.v_template, default_hand().v_template, atol=1e-6):
        raise ValueError(
            "synthetic captures show the hand of this package, and the model has another one, so that their "
            "vertices cannot be compared; evaluate a model that was trained with the package's hand"
        )
    return hand


def captures_config(config: "TrainConfig") -> "SyntheticConfig":
    """Return the experiment's distribution, with crops as the model wants them and all the views."""
    from poem_jax.evaluation.benchmark import MAX_VIEWS

    return dataclasses.replace(config.data.synthetic, image_hw=config.model.image_hw, num_views=MAX_VIEWS)
