"""What a run's folder says of the run: its config and its commit, compared before anything else is read."""

import json
from pathlib import Path

from poem_jax.io.atomic import whole_file
from poem_jax.io.json_file import read_json
from poem_jax.training.config import TrainConfig, config_json, differences

CONFIG_FILE = "train_config.json"
_COMMIT_FILE = "git_commit.txt"


def write_identity(run_dir: Path, config: TrainConfig, commit: str) -> None:
    """Write the resolved config and the commit of a sitting."""
    for name, text in ((CONFIG_FILE, config_json(config)), (_COMMIT_FILE, commit)):
        with whole_file(run_dir / name) as file:
            file.write_text(text + "\n", encoding="utf-8")


def check_same_config(run_dir: Path, config: TrainConfig, *, begun: bool) -> None:
    """Refuse to go on in a run directory that another experiment made.

    Args:
        run_dir: the run's folder.
        config: the experiment.
        begun: there are checkpoints; without any, a config beside them binds nobody.

    Raises:
        ValueError: the config stored there differs; names the fields and the flag that allows it.
    """
    file = run_dir / CONFIG_FILE
    if not file.is_file() or not begun:
        return
    stored = read_json(file, what="config of a run")
    if not isinstance(stored, dict):
        raise ValueError(f"{file} must hold the config of a run; got a {type(stored).__name__}. Remove it")
    # Through JSON, so that tuples and numbers compare as they were written.
    changed = differences(stored, json.loads(config_json(config)))
    if changed and not config.train.allow_config_change:
        raise ValueError(
            f"{run_dir} holds a run of another config: {'; '.join(changed[:10])}. "
            "Choose another --train.out, or pass --train.allow-config-change to go on with the new one"
        )
