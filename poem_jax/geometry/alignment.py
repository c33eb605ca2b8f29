"""Procrustes alignment of point sets, with and without reflection; follows the type of its arrays.

Letters: X, Y centred source and target (point, 3); M = Y^T X = U S V^T; R = U D V^T maps source directions to
target directions, D = diag(1, 1, det U V^T) where reflections are forbidden (Umeyama 1991, eq. 39-42).
"""

import functools
from typing import Any, NamedTuple

import numpy as np

from poem_jax.geometry.transforms import matmul, rotate_points, transpose
from poem_jax.typing import Array, Bool, Float, array_namespace


class SimilarityTransform(NamedTuple):
    """The map target = scale * R source + t."""

    R: Float[Array, "*batch 3 3"]
    """Rotation, or with reflections allowed any orthogonal matrix."""
    scale: Float[Array, "*batch"]
    t: Float[Array, "*batch 3"]


def procrustes(
    source: Float[Array, "*batch point 3"],
    target: Float[Array, "*batch point 3"],
    *,
    allow_reflection: bool = False,
    with_scale: bool = True,
    norm_epsilon: float = 0.0,
    mask: Bool[Array, "*batch point"] | None = None,
) -> SimilarityTransform:
    """Return the similarity that takes `source` closest to `target` in the sense of least squares.

    Args:
        source, target: corresponding points, in one unit.
        allow_reflection: accept an orthogonal matrix of determinant -1 if it fits better.
        with_scale: False fixes the scale at 1.
        norm_epsilon: added to the source's Frobenius norm; the official evaluators have 1e-8 there.
        mask: points that count; None means all.

    Returns: the similarity; a source without extent, or without points, gets scale 0 (with_scale) and R with
    finite values and gradients that mean nothing.
    """
    xp = array_namespace(source, target)
    if mask is not None:
        source, target = (xp.where(mask[..., None], points, 0) for points in (source, target))
    source_mean, target_mean = _mean(source, mask), _mean(target, mask)
    X, Y = source - source_mean[..., None, :], target - target_mean[..., None, :]
    if mask is not None:
        X, Y = (xp.where(mask[..., None], points, 0) for points in (X, Y))
    M = matmul(transpose(Y), X)
    R = nearest_rotation(M, allow_reflection=allow_reflection)
    scale = _scale(R, M, X, norm_epsilon) if with_scale else xp.ones_like(M[..., 0, 0])
    t = target_mean - scale[..., None] * rotate_points(R, source_mean[..., None, :])[..., 0, :]
    return SimilarityTransform(R, scale, t)


def apply_similarity(
    similarity: SimilarityTransform, points: Float[Array, "*#batch point 3"]
) -> Float[Array, "*#batch point 3"]:
    """Map points of the source's frame to the target's."""
    turned = rotate_points(similarity.R, points)
    return similarity.scale[..., None, None] * turned + similarity.t[..., None, :]


def nearest_rotation(
    M: Float[Array, "*batch 3 3"], *, allow_reflection: bool = False
) -> Float[Array, "*batch 3 3"]:
    """Return the rotation (or orthogonal matrix) R that maximises trace(R^T M).

    Its derivative in JAX divides by sums of singular values only, so it is right also where singular values
    repeat; where R is not determined (rank 1 or less) the undetermined part has zero derivative.
    """
    if array_namespace(M) is np:
        return _orthogonal(np.linalg.svd(M, full_matrices=False), allow_reflection)[0]
    return _differentiable_rotation()(M, allow_reflection)


def _mean(points: Array, mask: Array | None) -> Array:
    xp = array_namespace(points)
    if mask is None:
        return xp.mean(points, axis=-2)
    count = xp.sum(mask, axis=-1, keepdims=True).astype(points.dtype)
    return xp.sum(points, axis=-2) / xp.where(count > 0, count, xp.ones_like(count))


def _scale(R: Array, M: Array, X: Array, norm_epsilon: float) -> Array:
    """Return trace(R^T M) / |X|^2, zero for a source without extent."""
    xp = array_namespace(M)
    square = xp.sum(X * X, axis=(-2, -1))
    empty = square <= 0
    norm = xp.where(empty, 0, xp.sqrt(xp.where(empty, xp.ones_like(square), square))) + norm_epsilon
    trace = xp.sum(R * M, axis=(-2, -1))
    return xp.where(empty, xp.zeros_like(trace), trace / xp.where(empty, xp.ones_like(norm), norm) ** 2)


def _orthogonal(parts: tuple[Array, Array, Array], allow_reflection: bool) -> tuple[Array, Array, Array]:
    """Return R, V^T and the signed singular values, the last of them negated where a reflection was
    undone, from the parts U, S, V^T of a matrix."""
    U, S, Vt = parts
    if not allow_reflection:
        xp = array_namespace(U)
        sign = xp.where(xp.linalg.det(matmul(U, Vt)) < 0, -1, 1).astype(U.dtype)
        last = xp.asarray([0, 0, 1], dtype=U.dtype)
        signs = 1 + (sign[..., None] - 1) * last
        U, S = U * signs[..., None, :], S * signs
    return matmul(U, Vt), Vt, S


@functools.cache
def _differentiable_rotation() -> Any:
    """Build the JAX form of `_orthogonal` with its own derivative; JAX is imported only here."""
    import jax

    from poem_jax.geometry.singular_values import svd

    @functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
    def rotation(M: Array, allow_reflection: bool) -> Array:
        return _orthogonal(svd(M), allow_reflection)[0]

    @rotation.defjvp
    def rotation_jvp(allow_reflection: bool, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        R, Vt, S = _orthogonal(svd(primals[0]), allow_reflection)
        return R, _rotation_tangent(R, Vt, S, tangents[0])

    return rotation


def _rotation_tangent(R: Array, Vt: Array, S: Array, dM: Array) -> Array:
    """Return dR for M = R P with symmetric P = V S V^T.

    R^T dM = W P + dP with W = R^T dR antisymmetric, so that in V's basis W_ij (S_i + S_j) is the
    antisymmetric part of V^T R^T dM V, twice.
    """
    xp = array_namespace(dM)
    B = matmul(matmul(Vt, matmul(transpose(R), dM)), transpose(Vt))
    sums = S[..., :, None] + S[..., None, :]
    eps = float(xp.finfo(S.dtype).eps)
    closed = xp.abs(sums) <= 8 * eps * S[..., :1, None]
    W = xp.where(closed, 0, B - transpose(B)) / xp.where(closed, xp.ones_like(sums), sums)
    return matmul(R, matmul(matmul(transpose(Vt), W), Vt))
