"""What can be known to be wrong with a run before minutes are spent on compiling it."""

import importlib.util

from poem_jax.io.writable import check_folder_is_writable
from poem_jax.training.config import TrainConfig, config_json, git_commit
from poem_jax.training.hosts import check_same_everywhere


def check_before_training(config: TrainConfig) -> None:
    """Insist that a run can begin, and that it will be able to write what it finds.

    Raises:
        ModuleNotFoundError: an extra that the run needs is not installed; says how to get it.
        ValueError: the run directory cannot be written to, or the working tree has changes and
            `train.require_clean_commit` is on; or hosts differ in config or commit.
    """
    if importlib.util.find_spec("grain") is None:
        raise ModuleNotFoundError("training needs Grain: pip install 'poem-jax[train]'")
    if config.train.tensorboard and importlib.util.find_spec("tensorboardX") is None:
        raise ModuleNotFoundError(
            "`train.tensorboard` needs tensorboardX: pip install 'poem-jax[tensorboard]', or turn it off"
        )
    check_folder_is_writable(config.train.out, "--train.out")
    if config.train.require_clean_commit and git_commit().endswith(("+changes", "unknown")):
        raise ValueError("`train.require_clean_commit` is on, but the working tree has uncommitted changes")
    check_same_everywhere("config", config_json(config))
    check_same_everywhere("commit of the code", git_commit())
