"""The procedural weights are those that the reference's runs used, array by array."""

import hashlib

import numpy as np
import pytest

from tests.weights.v1_procedural import MODELS, batch_of, manifest, needs_reference_v1, state_dict

pytestmark = [needs_reference_v1, pytest.mark.parity]


@pytest.mark.parametrize("model", MODELS)
def test_every_array_has_the_stored_checksum(model):
    state = state_dict(model)
    wrong = [
        entry.name
        for entry in manifest(model)
        if entry.sha256_16 is not None
        and hashlib.sha256(state[entry.name].tobytes()).hexdigest()[:16] != entry.sha256_16
    ]
    assert not wrong


def test_master_cameras_are_the_world():
    for case, shape in (("a", (2, 4)), ("b", (1, 8))):
        batch = batch_of(case)
        assert batch.views.shape == (*shape, 256, 256, 3)
        np.testing.assert_allclose(batch.cameras.T_cam_from_world[:, 0], [np.eye(4)] * shape[0], atol=1e-12)
