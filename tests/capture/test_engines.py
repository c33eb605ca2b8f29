"""Which engines can run on a capture, and what is refused before anything is done."""

import numpy as np
import pytest

from poem_jax.capture.engines import EngineOptions, engine_for, try_network
from poem_jax.capture.frame import Frame
from poem_jax.capture.take import Take, read_take
from poem_jax.hand.template import default_hand
from tests.capture.stub_network import lost_network


def test_boxes_alone_leave_the_network(make_capture, caplog):
    caplog.set_level("INFO")
    chosen = engine_for(read_take(make_capture().folder), "auto", EngineOptions(network=lost_network()))
    assert chosen.choice.engine == "poem"
    assert chosen.choice.by == "only one can run"
    assert "boxes only" in chosen.choice.why
    assert "engine: poem, by only one can run: there are boxes only" in caplog.text


def test_key_points_without_images_leave_the_fit(make_capture):
    """No network is loaded for it: a checkpoint that is not there is of no account."""
    take = read_take(make_capture(3, keypoints=True).folder)
    bare = [frame._replace(image_files=(None,) * 3) for frame in take.frames]
    options = EngineOptions(checkpoint="nowhere")
    chosen = engine_for(take._replace(frames=bare), "auto", options)
    assert chosen.choice.engine == "fit"
    assert "no images" in chosen.choice.why


def test_no_hand_at_all_leaves_nothing_to_compare(rig):
    unseen = Frame(
        "0", np.full((1, 3, 4), np.nan), np.full((1, 3, 21, 2), np.nan), image_files=("a.png",) * 3
    )
    chosen = engine_for(Take(rig, ("right",), [unseen]), "auto", EngineOptions(network=lost_network()))
    assert chosen.choice.by == "nothing to compare"


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("fit", EngineOptions(checkpoint="ckpt"), "a fit has no weights"),
        ("poem", EngineOptions(detector="none"), "poem has its own hand"),
        ("poem", EngineOptions(hand=default_hand()), "poem has its own hand"),
        ("neural", EngineOptions(), "must be one of auto, fit, poem; got 'neural'"),
    ],
)
def test_what_does_not_go_together_is_refused(rig, name, options, message):
    with pytest.raises(ValueError, match=message):
        engine_for(Take(rig, ("right",), []), name, options)


def test_a_network_on_trial_reads_what_it_is_given_and_no_more(make_capture):
    """A lost image costs its view; the view that is left out needs none."""
    take = read_take(make_capture(1).folder)
    (frame,) = take.frames
    boxes = frame.boxes_px.copy()
    boxes[:, 1] = np.nan
    frame = frame._replace(boxes_px=boxes, image_files=(frame.image_files[0], None, frame.image_files[2]))
    fed = []
    (found,) = try_network(iter([frame]), take, lost_network(fed))
    assert not found.problems
    assert found.hands[0].view_mask.tolist() == [True, False, True]
    assert fed[0][0].tolist() == [True, False, True]
    assert np.isfinite(found.hands[0].joint_sigma_m).all()
