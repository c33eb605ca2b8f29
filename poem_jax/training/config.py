"""What an experiment is: frozen dataclasses nested by owner, written as plain Python in `experiments/`.

Importing this module starts no JAX backend, so that an entry point can still choose the devices.
"""

import dataclasses
import json
import subprocess
from dataclasses import dataclass, field
from enum import Enum
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from poem_jax.losses import PAPER, LossRecipe
from poem_jax.mixture.config import MixtureConfig
from poem_jax.models.config import Config, DecoderOutput, Frozen, ModelConfig, require
from poem_jax.synthetic.config import SyntheticConfig


class Schedule(Enum):
    """How the learning rate goes down after the warm-up."""

    CONSTANT = "constant"
    COSINE = "cosine"
    STEP = "step"


class Clip(Enum):
    """What the gradient norm is taken over before it is limited."""

    NONE = "none"
    GLOBAL = "global"
    PER_TENSOR = "per_tensor"


class DataParallel(Enum):
    """How a batch is split over the devices; the result is the same."""

    SHARD_MAP = "shard_map"
    JIT = "jit"


class Precision(Enum):
    """What the networks compute in; weights, statistics, geometry and losses stay in float32."""

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"


class Rematerialise(Enum):
    """What is computed again in the backward pass, to save memory; the result is the same."""

    NOTHING = "nothing"
    TRUNK = "trunk"
    DECODER = "decoder"
    BOTH = "both"


@dataclass(frozen=True)
class ComputeConfig:
    """How a step is computed."""

    precision: Precision = Precision.FLOAT32
    rematerialise: Rematerialise = Rematerialise.NOTHING
    accumulate: int = 1
    """Parts in which a device takes its share of a batch, one after the other; the gradient is that of the
    whole, batch norms see one part at a time."""

    def __post_init__(self) -> None:
        require(self.accumulate >= 1, f"`compute.accumulate` must be at least 1; got {self.accumulate}")


@dataclass(frozen=True)
class BatchShape:
    """One kind of batch. Every kind compiles its own program."""

    num_views: int = 4
    """Padded number of views."""
    batch_size: int = 16
    min_views: int | None = None
    """Samples have from this many to `num_views` views, uniformly; None = always `num_views`."""
    weight: float = 1.0
    """How often this kind is drawn, relative to the others."""

    def __post_init__(self) -> None:
        require(
            1 <= (self.min_views or 1) <= self.num_views,
            f"`min_views` must lie in 1..num_views = {self.num_views}; got {self.min_views}",
        )
        require(
            self.batch_size >= 1 and self.weight >= 0,
            f"`batch_size` must be at least 1 and `weight` at least 0; got {self}",
        )


@dataclass(frozen=True)
class DataConfig:
    """Where the training samples come from."""

    synthetic: SyntheticConfig = field(default_factory=SyntheticConfig)
    seed: int = 1
    """Seed of the training samples; evaluation uses others."""
    batches: tuple[BatchShape, ...] = (BatchShape(),)
    prefetch: int = 3
    """Batches drawn ahead in the background."""
    workers: int = 1
    """Threads that draw them; two at least where `mixture.processes` do."""
    mixture: MixtureConfig | None = None
    """Data sets to train on; None = synthetic captures alone. Validation is on synthetic ones and on what
    parts hold out."""

    def __post_init__(self) -> None:
        require(
            self.mixture is None or all(shape.min_views is None for shape in self.batches),
            "`min_views` of `data.batches` is for synthetic captures alone: with `data.mixture`, the `views` "
            f"of its parts say how many views a sample has; got {self.batches}",
        )
        require(
            sum(shape.weight for shape in self.batches) > 0,
            f"`data.batches` needs at least one shape with positive weight; got {self.batches}",
        )


class RootSource(Enum):
    """The point about which the second stage works in training."""

    TRUTH = "truth"
    """The true root joint, with noise (paper and release)."""
    TRIANGULATED = "triangulated"
    """The first stage's own where two views or more see the hand, as at inference; else the noisy truth."""


@dataclass(frozen=True)
class TrainingRoot:
    """The root joint about which the second stage works in training, and its noise in metres."""

    source: RootSource = RootSource.TRUTH
    per_coordinate_m: float = 0.01
    """Standard deviation per sample and coordinate."""
    shared_m: float = 0.0
    """Standard deviation of one number added to all coordinates of the batch (the release: 0.01)."""
    scale: float = 0.0
    """Largest relative scaling about the noisy wrist, one number per batch (the release: 0.01)."""
    max_error_m: float | None = 0.1
    """A sample whose root is farther than this from the true one does not count in the losses of the second
    stage, which sees nothing of the hand there and could only learn the mean: no basis point, in a ball of
    this radius, lies on the hand. None = all count, as in the release of POEM v1."""

    def __post_init__(self) -> None:
        require(
            self.max_error_m is None or self.max_error_m > 0,
            f"`max_error_m` must be positive, or None; got {self.max_error_m}",
        )


PAPER_ROOT = TrainingRoot()
"""Gaussian noise of 1 cm per sample and coordinate."""
RELEASE_ROOT = TrainingRoot(per_coordinate_m=0.01, shared_m=0.01, scale=0.01)
"""What the released training code does: noise on every joint, one shift and one scale a batch."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam, its learning-rate schedule, gradient clipping, and the moving average of the weights."""

    learning_rate: float = 1e-4
    first_stage_learning_rate: float | None = None
    """Highest rate of the steps that train the heat maps alone; None = the same."""
    b1: float = 0.9
    b2: float = 0.999
    eps: float = 1e-8
    weight_decay: float = 0.0
    schedule: Schedule = Schedule.COSINE
    warmup_steps: int = 0
    decay_steps: int | None = None
    """Steps (warm-up included) until the rate has reached its last value; None = the whole run."""
    final_ratio: float = 0.001
    """Last learning rate over the highest one."""
    drop_at: float = 0.7
    """Part of the run after which `Schedule.STEP` multiplies the rate by 0.1."""
    clip: Clip = Clip.GLOBAL
    clip_norm: float = 1.0
    ema_decay: float = 0.0
    """Decay per step of the moving average of weights and statistics; 0 = none."""


@dataclass(frozen=True)
class RunConfig:
    """Length, place and bookkeeping of a run."""

    steps: int = 1000
    seed: int = 0
    out: str = "runs/experiment"
    init_from: str | None = None
    """Folder of a model (`poem_jax.save`, `--export`) that a fresh run starts from; `shipped`: that of the
    package; None: random weights."""
    first_stage_from: str | None = None
    """Folder of a model, or `shipped`, whose trunk and heat maps a fresh run of another model starts from."""
    smooth_queries: bool = False
    """A fresh run's vectors for each query point begin alike where these are neighbours on the template
    (`query_start.py`), and not each for itself."""
    max_minutes: float | None = None
    """Stop after this time, with a checkpoint; the same command goes on from there."""
    log_every: int = 20
    checkpoint_every: int = 500
    keep_checkpoints: int = 2
    keep_best: bool = False
    """Also keep the checkpoint with the least vertex error in validation (`Validation.score`): the mean over
    the parts that hold frames out, or where none does, over the numbers of views."""
    skip_bad_steps: int = 0
    """Steps whose loss or gradient is not finite that a sitting may leave out; one more stops it."""
    panel_every: int = 0
    """Steps between pictures of what the model finds in held-out samples; 0 = never."""
    validate_every: int = 0
    """Steps between validations on held-out samples; 0 = never."""
    validation_samples: int = 32
    validation_views: tuple[int, ...] = (2, 4, 8)
    validation_seed: int = 424242
    host_devices: int = 1
    """CPU devices the entry point asks for; without effect on accelerators."""
    data_parallel: DataParallel = DataParallel.SHARD_MAP
    tensorboard: bool = False
    progress: bool = True
    allow_config_change: bool = False
    """Go on from a checkpoint although the config differs from the one it was made with."""
    require_clean_commit: bool = False
    """Refuse to start while the working tree has uncommitted changes."""

    def __post_init__(self) -> None:
        for name, minimum in _MINIMA.items():
            value = getattr(self, name)
            require(value >= minimum, f"`train.{name}` must be at least {minimum}; got {value}")
        require(
            self.max_minutes is None or self.max_minutes > 0,
            f"`train.max_minutes` must be positive, or None; got {self.max_minutes}",
        )
        require(
            min(self.validation_views, default=0) >= 1,
            f"`train.validation_views` must name view counts from 1; got {self.validation_views}",
        )


_MINIMA = {
    "steps": 0,
    "log_every": 1,
    "checkpoint_every": 1,
    "keep_checkpoints": 1,
    "skip_bad_steps": 0,
    "panel_every": 0,
    "validate_every": 0,
    "validation_samples": 1,
    "host_devices": 1,
}


@dataclass(frozen=True)
class TrainConfig:
    """A whole experiment."""

    name: str
    model: ModelConfig
    data: DataConfig = DataConfig()
    loss: LossRecipe = PAPER
    first_stage_steps: int = 0
    """Steps at the beginning that train trunk and heat maps alone, for less than half the cost of a whole
    step: the second stage then starts from joints that mean something. Adam's moments start anew after."""
    frozen_views: bool = False
    """What is done with every view alone stays as it is, batch norms included; the second stage learns."""
    frozen_first_stage: bool = False
    """Trunk and heat maps stay as they are, batch norms included; the maps that the second stage reads
    learn with it."""
    training_root: TrainingRoot = PAPER_ROOT
    optimizer: OptimizerConfig = OptimizerConfig()
    compute: ComputeConfig = ComputeConfig()
    train: RunConfig = RunConfig()

    @property
    def frozen(self) -> Frozen:
        """What stays as it is."""
        if self.frozen_views:
            return Frozen.VIEWS
        return Frozen.FIRST_STAGE if self.frozen_first_stage else Frozen.NOTHING

    def _check_frozen(self) -> None:
        run = self.train
        if self.frozen is Frozen.NOTHING:
            return
        name = "frozen_views" if self.frozen_views else "frozen_first_stage"
        require(
            not (self.frozen_views and self.frozen_first_stage),
            "`frozen_views` keeps all that `frozen_first_stage` does, and more; turn one of them off",
        )
        require(
            not self.first_stage_steps,
            f"`first_stage_steps` train what `{name}` keeps; got {self.first_stage_steps} of them",
        )
        given = run.init_from if self.frozen_views else run.init_from or run.first_stage_from
        also = "" if self.frozen_views else " or `train.first_stage_from`"
        require(
            given is not None,
            f"`{name}` keeps what `train.init_from`{also} gives; name a folder of weights, or `shipped`",
        )
        require(
            not self.optimizer.weight_decay,
            f"`optimizer.weight_decay` would shrink the weights that `{name}` keeps; set it to 0",
        )

    def __post_init__(self) -> None:
        run, data = self.train, self.data.synthetic
        devices, sizes = run.host_devices, [shape.batch_size for shape in self.data.batches]
        require(
            all(size % devices == 0 for size in sizes),
            f"every `batch_size` must be a multiple of `train.host_devices` = {devices}; got {sizes}",
        )
        parts = self.compute.accumulate
        require(
            all(size % (devices * parts) == 0 for size in sizes),
            "every `batch_size` must be a multiple of `train.host_devices` times `compute.accumulate` = "
            f"{devices} x {parts}; got {sizes}",
        )
        require(
            parts == 1 or not self.model.couples_samples,
            f"`compute.accumulate` must be 1 for this {type(self.model).__name__}, whose samples depend on "
            f"each other; got {parts}",
        )
        require(
            tuple(data.image_hw) == tuple(self.model.image_hw),
            f"`data.synthetic.image_hw` must be the model's {self.model.image_hw}; got {data.image_hw}",
        )
        mixture = self.data.mixture
        require(
            mixture is None or not predicts_parameters(self.model) or mixture.pose,
            "a parametric model learns pose and shape; turn `data.mixture.pose` on",
        )
        require(
            mixture is None or mixture.recipe.box_ratio == self.model.crop.ratio,
            f"`data.mixture.recipe.box_ratio` must be the model's `crop.ratio`, {self.model.crop.ratio}; got "
            f"{mixture and mixture.recipe.box_ratio}",
        )
        require(
            not self.model.crop.upright,
            "`model.crop.upright` is for models of upright hands; training crops are not turned upright",
        )
        require(
            run.init_from is None or run.first_stage_from is None,
            f"`train.init_from` has a first stage; got `train.first_stage_from` {run.first_stage_from} too",
        )
        require(
            run.init_from is None or not run.smooth_queries,
            "`train.init_from` has learned its query points' vectors; turn `train.smooth_queries` off",
        )
        self._check_frozen()
        require(
            not self.first_stage_steps or self.model.triangulates,
            f"`first_stage_steps` must be 0 for a {type(self.model).__name__} without a first stage; "
            f"got {self.first_stage_steps}",
        )
        looks = run.validate_every or run.panel_every
        least, most = self.model.view_range
        counts = sorted({shape.num_views for shape in self.data.batches})
        require(
            all(least <= n <= (most or n) for n in counts),
            f"`num_views` of `data.batches` must be {self.model.views_in_words}, as the layers of this "
            f"{type(self.model).__name__} are made for; got {counts}. `min_views` gives samples fewer",
        )
        require(
            not looks or max(run.validation_views) <= (most or max(run.validation_views)),
            f"`train.validation_views` must not exceed {most}, which the layers of this "
            f"{type(self.model).__name__} are made for; got {run.validation_views}",
        )
        max_views = max(shape.num_views for shape in self.data.batches)
        require(
            max_views <= data.num_views,
            f"`data.batches` asks for {max_views} views, but `data.synthetic.num_views` is {data.num_views}",
        )
        require(
            not looks or max(run.validation_views) <= data.num_views,
            f"`train.validation_views` must not exceed `data.synthetic.num_views` = {data.num_views}; "
            f"got {run.validation_views}",
        )


def predicts_parameters(model: ModelConfig) -> bool:
    """Say whether pose and shape are what the model learns, and its samples must have."""
    return isinstance(model, Config) and model.decoder.output is DecoderOutput.HAND_PARAMETERS


BOOKKEEPING = (
    "train.steps",
    "train.out",
    "train.max_minutes",
    "train.log_every",
    "train.checkpoint_every",
    "train.keep_checkpoints",
    "train.keep_best",
    "train.skip_bad_steps",
    "train.panel_every",
    "compute.rematerialise",
    "train.validate_every",
    "train.validation_samples",
    "train.validation_views",
    "train.validation_seed",
    "train.host_devices",
    "train.data_parallel",
    "train.tensorboard",
    "train.progress",
    "train.allow_config_change",
    "train.require_clean_commit",
    "data.prefetch",
    "data.workers",
    "data.mixture.processes",
    "data.mixture.max_corrupt_share",
)
"""Fields that may change between two sittings of one run: they do not touch what is learned."""


def flatten_config(config: Any, prefix: str = "") -> dict[str, Any]:
    """List every field of nested dataclasses by its dotted name, with JSON values."""
    if dataclasses.is_dataclass(config):
        items = [(f.name, getattr(config, f.name)) for f in dataclasses.fields(config)]
    elif isinstance(config, tuple | list):
        items = [(str(i), value) for i, value in enumerate(config)]
    elif isinstance(config, dict):
        items = [(str(key), value) for key, value in config.items()]
    else:
        return {prefix: config.value if isinstance(config, Enum) else config}
    flat: dict[str, Any] = {} if items else {prefix: []}
    for name, value in items:
        flat |= flatten_config(value, f"{prefix}.{name}" if prefix else name)
    return flat


def config_json(config: TrainConfig) -> str:
    """Write the resolved config as JSON: dotted names and values, one a line."""
    return json.dumps(flatten_config(config), indent=1)


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Describe the fields in which two flattened configs differ, bookkeeping aside."""
    ours = _learned(new)
    theirs = _as_before(ours) | _learned(old)
    missing = "absent"
    return [
        f"{key}: {theirs.get(key, missing)} -> {ours.get(key, missing)}"
        for key in sorted(ours.keys() | theirs.keys())
        if theirs.get(key, missing) != ours.get(key, missing)
    ]


_LATER = {
    "compute.precision": "float32",
    "compute.accumulate": 1,
    "data.mixture": None,
    "data.synthetic.cameras.rig": [],
    "data.mixture.parts.*.held_out": 0.0,
    "frozen_views": False,
    "frozen_first_stage": False,
    "train.first_stage_from": None,
    "train.smooth_queries": False,
    "model.joint_decoder": None,
    "model.backbone.frozen_norms": "none",
    "loss.reprojection_limit": 0.5,
    "loss.triangulation": 0.0,
    "loss.vertex_reprojection": 0.0,
    "training_root.max_error_m": 0.1,
}
"""Fields that runs of earlier versions do not name (`*`: any number), and what they did."""


def _as_before(ours: dict[str, Any]) -> dict[str, Any]:
    return {key: value for name, value in _LATER.items() for key in ours if fnmatchcase(key, name)}


def _learned(flat: dict[str, Any]) -> dict[str, Any]:
    """Keep the fields that decide what is learned: the length of a run only where its schedule spans it."""
    kept = {key: value for key, value in flat.items() if not key.startswith(BOOKKEEPING)}
    kept["optimizer.decay_steps"] = flat.get("optimizer.decay_steps") or flat.get("train.steps")
    return kept


def git_commit(file: str | Path = __file__) -> str:
    """Return the commit of the checkout that `file` of this package comes from, with `+changes` if tracked
    files differ from it; `unknown` without git, or where the package is installed and not checked out."""
    file = Path(file).resolve()
    try:
        _git(file.parent, "ls-files", "--error-unmatch", file.name)
        commit = _git(file.parent, "rev-parse", "HEAD")
        return commit + ("+changes" if _git(file.parent, "status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(folder: Path, *arguments: str) -> str:
    result = subprocess.run(
        ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True
    )
    return result.stdout.strip()
