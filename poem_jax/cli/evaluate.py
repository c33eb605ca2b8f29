"""`poem eval`."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from poem_jax.cli.inspect import Kinds
from poem_jax.cli.messages import say
from poem_jax.cli.options import Flag, Folder, OptionalFile, OptionalFolder

if TYPE_CHECKING:
    from poem_jax.hand.model import HandModel
    from poem_jax.models.config import ModelConfig
    from poem_jax.synthetic.config import SyntheticConfig
    from poem_jax.synthetic.dataset import SyntheticDataset
    from poem_jax.training.config import TrainConfig
    from poem_jax.typing import Params


_DEFAULT_VIEWS = "1,2,4,8"
_DEFAULT_SAMPLES = 200
_OUT = Path("out/tables")
_OF_ALL = frozenset({"seed", "samples", "batch_size", "no_progress", "debug"})
_OF_TABLES = frozenset({"table", "dataset", "out", "data_root", "checkpoints"})
_OF_DATASETS = frozenset(
    {"dataset", "checkpoint", "protocol", "views", "json", "kind", "split", "mano", "given_root"}
)
_OF_EXPERIMENTS = frozenset({"experiment", "checkpoint", "protocol", "views", "json", "stages"})
"""Options that a way of evaluating reads; another one is refused."""


@dataclass(frozen=True)
class Eval:
    """Evaluate a model: on synthetic captures (EXPERIMENT), on a data set (--dataset), or all of a table of
    the paper (--table); one of the three.

    EXPERIMENT prints the paper's columns by view count, and which stage fails. --table runs the rows whose
    data and weights are here, and lists what to download for the others; see docs/tables.md.

    The joints of every column are the model's direct predictions. Only --protocol poem-release takes them for
    AUC alone, and joints regressed from the vertices of both sides for MPJPE, RR-J and PA-J, as POEM's
    released evaluation does.
    """

    experiment: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="EXPERIMENT")] = None
    """An experiment of the package, such as tiny_synthetic, or a Python file that defines `config`; it names
    the model and the distribution of captures."""
    table: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """main, ablation, robustness, v2, ho3d-v2, ho3d-v3, single-view, real-world or synthetic."""
    dataset: Annotated[str | None, tyro.conf.arg(metavar="PATH")] = None
    """Tars, the folder of a raw set, or a labelled capture; with --table real-world, its capture."""
    checkpoint: OptionalFolder = None
    """Model folder that poem_jax.save or `poem train --export` wrote; without it the shipped weights."""
    protocol: Literal["poem", "poem-release", "freihand", "ho3d", "dexycb"] = "poem"
    """Whose definitions."""
    views: Annotated[str | None, tyro.conf.arg(metavar="N,N")] = None
    """View counts of captures (1,2,4,8). Of a data set: all, 4 (the first four), random (all, in random
    order), random:4 or random:2-8; without it all."""
    seed: int = 20261122
    """Of the captures, or of what is drawn of a data set's cameras."""
    samples: int | None = None
    """Captures (200), or samples of a data set, evenly spread over it; without it all."""
    batch_size: int = 8
    """Captures at a time."""
    json: OptionalFile = None
    """Write all metrics there: of captures by view count, of a data set as a table's row."""
    out: Folder = _OUT
    """With --table: folder for NAME.md, NAME.json, NAME.png and a submission of HO-3D's."""
    data_root: Folder = Path("data")
    """With --table: folder with dataset_tars/, raw/, mano/MANO_RIGHT.pkl."""
    checkpoints: Folder = Path("checkpoints")
    """With --table: folder of the models' folders."""
    kind: Kinds | None = None
    """With --dataset: what PATH is; found out where it is not said."""
    split: str | None = None
    """With --dataset: without it the paper's test split; tars say theirs in their names."""
    mano: OptionalFile = None
    """With --dataset: your MANO_RIGHT.pkl, where labels need it."""
    given_root: Flag = False
    """With --dataset: give the model the true root; a sample of one view gets it in any case."""
    stages: Flag = False
    """Print, too, which stage does the work: errors after each layer, and with features, root or joints
    replaced (for 2 views or more, on whole batches of captures; not in the JSON file)."""
    no_progress: Flag = False
    """Show no progress bar."""
    debug: Flag = False
    """Show the full traceback of an error."""

    def run(self) -> None:
        """Evaluate, print the tables, and write the files."""
        captures_of_a_table = self.table is not None and self.dataset is not None
        asked = [self.experiment, self.table, None if captures_of_a_table else self.dataset]
        if sum(one is not None for one in asked) != 1:
            raise ValueError(
                "say one of EXPERIMENT, --table NAME and --dataset PATH; got "
                f"{', '.join(one for one in asked if one is not None) or 'none'}"
            )
        if self.table is not None:
            self._check_all_are_read("--table", _OF_TABLES)
            self._run_table(self.table)
        elif self.dataset is not None:
            self._check_all_are_read("--dataset", _OF_DATASETS)
            self._run_dataset(self.dataset)
        else:
            assert self.experiment is not None
            self._check_all_are_read("EXPERIMENT", _OF_EXPERIMENTS)
            self._run_experiment(self.experiment)

    def _check_all_are_read(self, way: str, options: frozenset[str]) -> None:
        given = [field for field in dataclasses.fields(self) if getattr(self, field.name) != field.default]
        unread = [field.name for field in given if field.name not in options | _OF_ALL]
        if unread:
            names = ", ".join("--" + name.replace("_", "-") for name in unread)
            raise ValueError(f"{way} does not go with {names}: leave it out")

    def _run_table(self, name: str) -> None:
        from poem_jax.io.writable import check_folder_is_writable
        from poem_jax.tables.all_tables import table_named
        from poem_jax.tables.layout import as_markdown, write_table
        from poem_jax.tables.picture import write_picture
        from poem_jax.tables.places import Places
        from poem_jax.tables.result import RunSettings

        table = table_named(name)
        if self.dataset is not None and name != "real-world":
            raise ValueError(f"--dataset goes with --table real-world, or without a table; got {name}")
        check_folder_is_writable(self.out)
        capture = None if self.dataset is None else Path(self.dataset)
        places = Places(self.data_root, self.checkpoints, own_capture=capture)
        settings = RunSettings(
            str(self.out), self.samples, self.batch_size, self.seed, progress=not self.no_progress
        )
        result = table.run(places, settings)
        picture = f"{name}.png"
        write_picture(self.out / picture, result)
        paths = write_table(self.out, result, picture)
        print(as_markdown(result))
        for path in (*paths, self.out / picture, *result.files):
            print(f"written: {path}")

    def _run_dataset(self, path: str) -> None:
        from poem_jax.data.view_sampling import cameras_named
        from poem_jax.evaluation.dataset import SetSettings
        from poem_jax.io.writable import check_file_is_writable
        from poem_jax.mixture.recognise import Kind
        from poem_jax.tables.layout import as_markdown, write_json
        from poem_jax.tables.own_set import open_path, score_path

        if self.json is not None:
            check_file_is_writable(self.json, "--json")
        settings = SetSettings(
            cameras=cameras_named(self.views or "all"),
            protocol=self.protocol,
            given_root=self.given_root,
            samples=self.samples,
            batch_size=self.batch_size,
            seed=self.seed,
            progress=not self.no_progress,
        )
        kind = None if self.kind is None else Kind(self.kind)
        source = open_path(path, kind, split=self.split, mano=self.mano)
        result = score_path(source, self.checkpoint, settings)
        if self.json is not None:
            write_json(self.json, result)
        print(as_markdown(result))

    def _run_experiment(self, experiment: str) -> None:
        from poem_jax.evaluation.benchmark import BenchmarkSettings, model_predictor, run_benchmark
        from poem_jax.evaluation.first_stage_fitting import FirstStageFitting, sees_joints
        from poem_jax.evaluation.protocols import PROTOCOLS
        from poem_jax.evaluation.stages import check_has_stages
        from poem_jax.evaluation.tables import format_report, write_json
        from poem_jax.experiments import open_experiment
        from poem_jax.io.writable import check_file_is_writable
        from poem_jax.synthetic.dataset import SyntheticDataset
        from poem_jax.weights.store import SHIPPED, load

        views = view_counts(self.views or _DEFAULT_VIEWS)
        samples = _DEFAULT_SAMPLES if self.samples is None else self.samples
        if self.json is not None:
            check_file_is_writable(self.json, "--json")
        if self.stages and (max(views) < 2 or self.batch_size < 2 or samples < self.batch_size):
            raise ValueError(
                "--stages needs a view count of 2 or more, and --samples of at least one batch of 2 or more; "
                f"got --views {self.views or _DEFAULT_VIEWS}, --samples {samples}, "
                f"--batch-size {self.batch_size}"
            )
        settings = BenchmarkSettings(
            views=views,
            samples=samples,
            seed=self.seed,
            batch_size=self.batch_size,
            protocol=self.protocol,
            progress=not self.no_progress,
        )
        config = open_experiment(experiment)
        if self.stages:
            check_has_stages(config.model)
        captures = SyntheticDataset(captures_config(config), seed=self.seed)
        weights = self.checkpoint or SHIPPED
        _, params = load(weights, expected=config.model)
        hand = hand_of_captures(params)
        say(f"{samples} captures; every view count compiles a program, once on this machine")
        start = time.perf_counter()
        fitting = FirstStageFitting(config.model, params) if sees_joints(config.model) else None
        results = run_benchmark(model_predictor(params, config.model), captures, settings, hand, fitting)
        seconds = time.perf_counter() - start
        if self.json is not None:
            write_json(self.json, results)
        seen = ", which is the TRAINING seed" if self.seed == config.data.seed else ""
        print(f"{config.name}: weights {weights}, protocol {self.protocol}")
        print(f"{samples} synthetic captures of seed {self.seed}{seen}; {seconds:.0f} s\n")
        print(format_report(results, regressed_joints=PROTOCOLS[self.protocol].regresses_joints))
        if self.stages:
            self._print_stages(params, config.model, captures, views, samples)

    def _print_stages(
        self,
        params: "Params",
        model: "ModelConfig",
        captures: "SyntheticDataset",
        views: tuple[int, ...],
        samples: int,
    ) -> None:
        from poem_jax.evaluation.stages import format_stages, stage_errors

        samples, size = samples - samples % self.batch_size, self.batch_size
        say(f"{samples} captures again, each part of the model replaced in turn")
        print()
        print(
            format_stages(
                {
                    count: stage_errors(
                        params, model, captures, samples=samples, num_views=count, batch_size=size
                    )
                    for count in views
                    if count > 1
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
