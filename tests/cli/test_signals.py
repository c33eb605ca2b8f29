"""How commands end: by a signal, and when nobody reads what they print."""

import gc
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass

import pytest

from poem_jax.cli import main, run
from poem_jax.cli.demo import Demo
from poem_jax.cli.messages import tells_what_is_left
from poem_jax.cli.signals import stop_on_signals
from poem_jax.io.stopping import Stopped

POEM = (sys.executable, "-m", "poem_jax.cli")


@dataclass(frozen=True)
class Endless(Demo):
    """A command that writes one file and goes on until it is stopped."""

    kind: signal.Signals = signal.SIGINT
    writes: bool = True

    def run(self) -> None:
        with tells_what_is_left(self.out):
            if self.writes:
                self.out.mkdir()
                (self.out / "prediction.npz").write_text("")
            os.kill(os.getpid(), self.kind)
            time.sleep(10)
            raise AssertionError("the command went on")


@pytest.mark.parametrize(("kind", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("writes", [True, False])
def test_a_signal_ends_a_command_in_words(tmp_path, monkeypatch, capsys, kind, code, writes):
    out = tmp_path / "out"
    monkeypatch.setattr(run, "parse", lambda _: Endless(out, kind=kind, writes=writes))
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    assert main([]) == code
    error = capsys.readouterr().err
    assert (f"what was done so far is in {out}" if writes else f"nothing was written to {out}") in error
    assert f"poem: stopped by {kind.name}" in error
    assert "Traceback" not in error
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


def test_a_signal_that_comes_while_garbage_is_collected_is_not_lost():
    """JAX has such a callback; what is raised in one goes no further."""

    def callback(phase, info):
        gc.callbacks.remove(callback)
        os.kill(os.getpid(), signal.SIGTERM)

    def work():
        with stop_on_signals():
            gc.callbacks.append(callback)
            gc.collect()
            time.sleep(10)
            raise AssertionError("the command went on")

    with pytest.raises(Stopped, match="SIGTERM"):
        work()


@pytest.mark.parametrize("module", ["tyro", "poem_jax.cli.run"])
def test_a_signal_that_comes_while_the_program_is_loaded(module):
    stop_at = (
        "import builtins, sys\n"
        "def stop(name, *rest, real=builtins.__import__, **more):\n"
        f"    if name == {module!r}: raise KeyboardInterrupt\n"
        "    return real(name, *rest, **more)\n"
        "builtins.__import__ = stop\n"
        "from poem_jax.cli import start\n"
        "sys.exit(start(['--help']))\n"
    )
    done = subprocess.run([sys.executable, "-c", stop_at], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "poem: stopped by SIGINT\n")


def test_the_files_of_an_earlier_run_are_not_what_was_done(tmp_path, capsys):
    old = tmp_path / "prediction.npz"
    old.write_text("")
    os.utime(old, (1.0, 1.0))
    with pytest.raises(KeyboardInterrupt), tells_what_is_left(tmp_path):
        raise KeyboardInterrupt
    assert "nothing was written" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--help"], ["train", "tiny_synthetic", "--help"]])
def test_a_reader_that_leaves_ends_nothing(arguments):
    """As in `poem ... | head -1`: no word about pipes, and the exit code of the work."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*POEM, *arguments], stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_errors_that_nobody_reads_still_have_their_exit_code():
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*POEM, "train", "none"], stdout=writer, stderr=writer)
    os.close(writer)
    assert done.returncode == 2
