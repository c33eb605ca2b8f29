"""Where hands are on average in a training set: the place of the ball in POEM v1's ablation of one stage."""

from collections.abc import Iterable

import numpy as np

from poem_jax.batch import MultiViewBatch
from poem_jax.geometry.cameras import anchor_to_primary
from poem_jax.geometry.transforms import transform_points
from poem_jax.hand.topology import ROOT_JOINT


def mean_root(batches: Iterable[MultiViewBatch]) -> tuple[float, float, float]:
    """Average the root joint in each sample's primary camera's frame, metres, for
    `poem_v1_config.one_stage`.

    Args:
        batches: of the training set; padded samples and samples without a valid view do not count.

    Raises:
        ValueError: no sample counts.
    """
    total, count = np.zeros(3), 0
    for batch in batches:
        view_mask = np.asarray(batch.cameras.view_mask)
        exists = view_mask.any(-1)
        if batch.sample_mask is not None:
            exists = exists & np.asarray(batch.sample_mask)
        T_cam_from_world = np.asarray(batch.cameras.T_cam_from_world, np.float64)[exists]
        _, T_primary_from_world = anchor_to_primary(T_cam_from_world, view_mask[exists])
        root_world = np.asarray(batch.joints_world, np.float64)[exists, ROOT_JOINT]
        total += transform_points(T_primary_from_world, root_world[:, None])[:, 0].sum(0)
        count += int(exists.sum())
    if count == 0:
        raise ValueError("`batches` must hold at least one sample with a valid view; got none")
    x, y, z = (total / count).tolist()
    return x, y, z
