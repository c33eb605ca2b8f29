"""The way through the network is short enough to read."""

import sys
from dataclasses import replace
from pathlib import Path

import jax

from poem_jax import models
from poem_jax.models.apply import apply

ROOM = Path(models.__file__).parent


def test_a_forward_pass_enters_at_most_twelve_files(micro_config, make_params, make_scene):
    entered = set()

    def note(frame, event, argument):
        if event == "call" and Path(frame.f_code.co_filename).parent == ROOM:
            entered.add(Path(frame.f_code.co_filename).name)

    views, cams = make_scene(2, 3)
    params = make_params(micro_config)
    untraced = replace(micro_config, image_mean=0.25)
    sys.setprofile(note)
    try:
        jax.make_jaxpr(lambda views: apply(params, views, cams, config=untraced))(views)
    finally:
        sys.setprofile(None)
    assert {"apply.py", "network.py", "decoder.py"} <= entered
    assert len(entered) <= 12, sorted(entered)
