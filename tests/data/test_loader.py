import itertools
import subprocess
import sys
import threading
import time

import pytest

from poem_jax.data.loader import draw_ahead


def late(step):
    time.sleep(0.01 * (step % 3))
    return step


def take(n, draw=late, first=0, **settings):
    return list(itertools.islice(draw_ahead(draw, first, **{"ahead": 4, "workers": 3, **settings}), n))


@pytest.mark.parametrize("workers", [1, 3])
def test_every_step_comes_once_and_in_order(workers):
    assert take(12, workers=workers) == list(range(12))


def test_resuming_equals_not_stopping():
    assert take(5, first=7) == take(12)[7:]


def test_closing_stops_the_drawing():
    drawn = []

    def draw(step):
        drawn.append(step)
        return step

    before = threading.active_count()
    source = draw_ahead(draw, 3, ahead=4, workers=2)
    assert [next(source) for _ in range(3)] == [3, 4, 5]
    source.close()
    count = len(drawn)
    time.sleep(0.1)
    assert len(drawn) == count <= 3 + 4 + 2
    assert threading.active_count() <= before + 1


def test_errors_reach_the_caller_at_their_step():
    def draw(step):
        if step == 2:
            raise OSError(f"sample {step} cannot be read")
        return step

    source = draw_ahead(draw, 0, ahead=2, workers=1)
    assert [next(source), next(source)] == [0, 1]
    with pytest.raises(OSError, match="sample 2 cannot be read"):
        next(source)


@pytest.mark.parametrize("wrong", [{"workers": 0}, {"ahead": 0}, {"first": -1}])
def test_bad_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="at least 1 and `first` at least 0"):
        take(1, **wrong)


def test_naming_the_loader_imports_no_jax():
    code = "import sys, poem_jax.data.loader; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_grain_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "grain", None)
    with pytest.raises(ModuleNotFoundError, match=r"poem-jax\[train\]"):
        draw_ahead(late, 0, ahead=1, workers=1)
