import numpy as np
import pytest

from poem_jax.models.poem_v1_config import one_stage
from poem_jax.training.mean_root import mean_root


def test_it_is_the_mean_over_samples_before_their_first_valid_view(batch_at):
    """Of batches of different sizes, whose world is no camera's; padding does not count."""
    batches, roots = [batch_at(0, 3), batch_at(1, 2), batch_at(2, 1)], []
    batches[0].cameras.view_mask[:] = [[0, 1, 1], [1, 1, 1], [0, 0, 0]]
    batches[1].sample_mask[:] = [False, True]
    for b, i, view in ((0, 0, 1), (0, 1, 0), (1, 1, 0), (2, 0, 0)):
        T = batches[b].cameras.T_cam_from_world[i, view]
        roots.append(T[:3, :3] @ batches[b].joints_world[i, 9] + T[:3, 3])
    origin = mean_root(iter(batches))
    np.testing.assert_allclose(origin, np.mean(roots, 0), atol=1e-6)
    assert np.abs(origin).max() > 0.1
    assert one_stage(origin).first_stage.origin == origin


def test_a_set_without_samples_is_refused(batch_at):
    empty = batch_at(0, 2)
    empty.sample_mask[:] = False
    with pytest.raises(ValueError, match="at least one sample with a valid view; got none"):
        mean_root([empty])
