"""What is known of how a model was trained: the line that its log comes to, and its run's config."""

import json

from poem_jax.tables.training_summary import Training, training_of


def test_it_says_steps_errors_and_hours(tmp_path):
    lines = [
        {"group": "train", "step": 100, "steps_per_second": 0.5, "mpvpe_mm": 70.0},
        {"group": "validation", "step": 100, "mpvpe_mm": 1.0},
        {"group": "train", "step": 200, "steps_per_second": 0.1, "mpvpe_mm": 50.0},
        {"group": "train", "step": 200, "steps_per_second": 0.25, "mpvpe_mm": 45.25},
    ]
    (tmp_path / "metrics.jsonl").write_text(
        "".join(json.dumps(line) + "\n" for line in lines) + '{"group": "tr'
    )
    (tmp_path / "train_config.json").write_text('{"name": "a"}')
    # 100 steps of 2 s, and 100 of 4 s, which were taken again after a stop.
    summary = f"200 steps, training MPVPE 70 to 45.2 mm, {600 / 3600:.1f} h"
    assert training_of(tmp_path) == Training(summary, '{"name": "a"}')


def test_without_a_log_it_says_nothing(tmp_path):
    assert training_of(tmp_path / "none") == Training()
    (tmp_path / "metrics.jsonl").touch()
    assert training_of(tmp_path) == Training()
