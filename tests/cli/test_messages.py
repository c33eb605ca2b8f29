"""What a command says of itself."""

import sys

import pytest

from poem_jax.cli.messages import called_as


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["/venv/bin/poem", "train", "tiny_synthetic"], "poem train tiny_synthetic"),
        (
            ["train.py", "configs/a.py", "--train.out", "my runs"],
            "python train.py configs/a.py --train.out 'my runs'",
        ),
        (
            ["/venv/lib/site-packages/poem_jax/cli/__main__.py", "train", "finetune"],
            "python -m poem_jax.cli train finetune",
        ),
    ],
)
def test_a_command_can_be_given_again(monkeypatch, argv, said):
    monkeypatch.setattr(sys, "argv", argv)
    assert called_as() == said
