"""What a command says of itself."""

import logging
import sys

import pytest

from poem_jax.cli.messages import called_as, set_up_logging


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


@pytest.mark.parametrize(
    ("file", "failed", "said"),
    [
        ("/lib/orbax/checkpoint/threads.py", True, False),
        ("/lib/orbax/checkpoint/threads.py", False, True),
        ("/lib/grain/workers.py", True, True),
    ],
)
def test_what_orbax_raises_it_need_not_log(monkeypatch, capsys, file, failed, said):
    root = logging.Logger("root of this test")
    monkeypatch.setattr(logging, "root", root)
    set_up_logging()
    error = (OSError, OSError("disk full"), None) if failed else None
    root.handle(logging.LogRecord("absl", logging.ERROR, file, 1, "a thread failed", (), error))
    assert ("poem: a thread failed" in capsys.readouterr().err) == said
