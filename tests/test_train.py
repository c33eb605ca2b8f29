"""The command line of training."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENT = """
from poem_jax.synthetic.config import SyntheticConfig
from poem_jax.training.config import BatchShape, DataConfig, RunConfig, TrainConfig
from tests.micro import MICRO

config = TrainConfig(
    name="micro",
    model=MICRO,
    data=DataConfig(
        synthetic=SyntheticConfig(image_hw=(32, 32), num_views=2, supersample=1, num_backgrounds=2),
        batches=(BatchShape(num_views=2, batch_size=2),),
    ),
    train=RunConfig(steps=2, out=OUT, log_every=1, checkpoint_every=1, host_devices=2),
)
"""


@pytest.fixture
def experiment(tmp_path) -> Path:
    file = tmp_path / "micro.py"
    file.write_text(EXPERIMENT.replace("OUT", repr(str(tmp_path / "run"))))
    return file


def run_train(*arguments, **environment):
    """Run it compiled as the suite is, but with the devices that it chooses itself."""
    flags = os.environ["XLA_FLAGS"].replace("--xla_force_host_platform_device_count=2", "")
    clean = {key: value for key, value in os.environ.items() if key != "PJRT_NPROC"} | {"XLA_FLAGS": flags}
    return subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *map(str, arguments)],
        capture_output=True,
        text=True,
        env=clean | environment,
        cwd=ROOT,
    )


def test_wrong_commands_say_what_is_wrong(experiment, tmp_path):
    missing = run_train(tmp_path / "absent.py")
    assert missing.returncode == 2
    assert "experiment file not found" in missing.stderr
    unknown = run_train(experiment, "--train.stepz", 3)
    assert unknown.returncode == 2
    assert "--train.stepz" in unknown.stderr
    odd = run_train(experiment, "--train.host-devices", 3)
    assert odd.returncode == 2
    assert "every `batch_size`" in odd.stderr
    nothing = run_train(experiment, "--export", tmp_path / "model")
    assert nothing.returncode == 2
    assert "no checkpoints in" in nothing.stderr


@pytest.mark.slow
def test_trains_on_two_devices_goes_on_and_exports(experiment, tmp_path):
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "xla")}
    first = run_train(experiment, **cache)
    assert first.returncode == 0, first.stderr
    assert "devices ['cpu:0', 'cpu:1']" in first.stderr
    assert "step 2 of 2" in first.stdout
    again = run_train(experiment, "--train.steps", 3, "--optimizer.decay-steps", 2, **cache)
    assert again.returncode == 0, again.stderr
    assert "resumed at step 2" in again.stderr
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2, 3]
    exported = run_train(experiment, "--export", tmp_path / "model", "--optimizer.decay-steps", 2, **cache)
    assert exported.returncode == 0, exported.stderr
    assert (tmp_path / "model" / "config.json").is_file()
