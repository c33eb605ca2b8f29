"""The alignments of the official evaluators, one transform per sample, all samples at once (NumPy)."""

import numpy as np

from poem_jax.evaluation.protocols import PROCRUSTES_EPSILON, SCALE_JOINT
from poem_jax.geometry.alignment import SimilarityTransform, apply_similarity, procrustes
from poem_jax.geometry.transforms import rotate_points
from poem_jax.hand.topology import WRIST
from poem_jax.typing import Float


def fit_similarity(
    pred: Float[np.ndarray, "sample point 3"], gt: Float[np.ndarray, "sample point 3"]
) -> SimilarityTransform:
    """Fit rotation *or reflection*, scale and shift from each prediction to its ground truth.

    All four evaluators divide both centred sets by (Frobenius norm + 1e-8) and multiply by the ground truth's
    again; that factor cancels, so only the prediction's epsilon is left (`norm_epsilon`). A prediction
    collapsed to one point gets scale 0: every aligned point is then the mean of the ground truth.
    """
    return procrustes(pred, gt, allow_reflection=True, norm_epsilon=PROCRUSTES_EPSILON)


def align(
    pred: Float[np.ndarray, "sample point 3"], gt: Float[np.ndarray, "sample point 3"]
) -> Float[np.ndarray, "sample point 3"]:
    """Return the predictions, Procrustes-aligned to their ground truth (`fit_similarity`)."""
    return apply_similarity(fit_similarity(pred, gt), pred)


def align_by_joints(
    points: Float[np.ndarray, "sample other 3"],
    pred_joints: Float[np.ndarray, "sample joint 3"],
    gt_joints: Float[np.ndarray, "sample joint 3"],
) -> Float[np.ndarray, "sample other 3"]:
    """Move another mesh by the joints' alignment, as FreiHAND and HO-3D do where it is not MANO's.

    As in their `align_by_trafo`, the set turns about its own mean, and the division by the norm of the
    predicted joints, which the fit contains, is left out; kept, because published numbers contain it.
    """
    fit = fit_similarity(pred_joints, gt_joints)
    joints_mean, points_mean = pred_joints.mean(-2, keepdims=True), points.mean(-2, keepdims=True)
    norm = np.linalg.norm(pred_joints - joints_mean, axis=(-2, -1)) + PROCRUSTES_EPSILON
    turned = rotate_points(fit.R, points - points_mean) * (fit.scale * norm)[:, None, None]
    return turned + (gt_joints.mean(-2, keepdims=True) - joints_mean) + points_mean


def subtract_wrist(
    points: Float[np.ndarray, "sample point 3"], joints: Float[np.ndarray, "sample joint 3"]
) -> Float[np.ndarray, "sample point 3"]:
    """Return the points (joints or vertices) relative to joint 0 of the same hand."""
    return points - joints[:, WRIST, None]


def scale_translation(
    pred: Float[np.ndarray, "sample joint 3"], gt: Float[np.ndarray, "sample joint 3"]
) -> Float[np.ndarray, "sample joint 3"]:
    """Scale each prediction so that |joint 4 - joint 0| is the ground truth's, then put the wrists together.

    HO-3D's `align_sc_tr`. Joint 4 is the one at index 4 of the given order: the middle knuckle in HO-3D's
    own, the thumb's tip in OpenPose's. A prediction in which the two coincide is scaled by the true length.
    """
    pred_length = np.linalg.norm(pred[:, SCALE_JOINT] - pred[:, WRIST], axis=-1)
    gt_length = np.linalg.norm(gt[:, SCALE_JOINT] - gt[:, WRIST], axis=-1)
    # In the official order of operations: it decides which points count as exact at the threshold 0.
    scaled = pred / np.where(pred_length > 0, pred_length, 1.0)[:, None, None] * gt_length[:, None, None]
    return scaled - scaled[:, WRIST, None] + gt[:, WRIST, None]
