"""Silhouette terms: a posed hand's soft silhouette in every view against masks.

Letters: s = -log(1 - alpha) is the soft coverage of a pixel, alpha its soft silhouette, m in [0, 1] the mask;
`render/soft.py` fixes sigma and the blur radius, whose defaults here are the release's. With the release's
sigma only pixels within a fifth of a pixel of the outline pull; larger ones pull from further away, but
towards a biased place, as soft silhouettes are wider than masks: displaced by 9 mm, the shipped hand in four
views of 64 or 128 px comes back to 0.3-0.4 mm with sigma 1e-5, 1.2-2.0 mm with 1e-4, 1.7-3.5 mm with 3e-4.

Every loss is a mean over the valid views and all pixels, one number per batch entry, 0 where no view is
valid. Masked views may hold anything, NaN included: they change neither a loss nor a gradient.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp

from poem_jax.geometry.cameras import Cameras, fill_masked_views, project, resize_intrinsics
from poem_jax.render.soft import RELEASE_BLUR_RADIUS, RELEASE_SIGMA, soft_coverage
from poem_jax.typing import Array, Bool, Float, Int, Num

Masks: TypeAlias = Num[Array, "*batch view mask_h mask_w"] | Bool[Array, "*batch view mask_h mask_w"]
"""What was seen of the hand, in [0, 1]; must be of the size that was drawn."""

LOG_FLOOR = -100.0
"""Smallest logarithm in the cross-entropy, as in PyTorch's `binary_cross_entropy`."""


class SilhouetteTarget(NamedTuple):
    """What was seen of a hand, for `silhouette_of_views`."""

    masks: Masks
    cams: Cameras
    """The views; `K` counts pixels of the masks themselves (`geometry.cameras.resize_intrinsics`)."""


def silhouette_of_views(
    vertices_world: Float[Array, "*batch vert 3"],
    faces: Int[Array, "face 3"],
    target: SilhouetteTarget,
    loss: Callable[[Array, Masks, Array], Array],
    *,
    sigma: float = RELEASE_SIGMA,
) -> Float[Array, "*batch"]:
    """Return `loss` (`silhouette_l1` or `silhouette_cross_entropy`) of a mesh, metres, against masks.

    The blur radius is the release's multiple of `sigma`.
    """
    size = target.masks.shape[-2:]
    blur_radius = RELEASE_BLUR_RADIUS / RELEASE_SIGMA * sigma
    coverage = view_coverage(
        vertices_world, faces, target.cams, size, size, sigma=sigma, blur_radius=blur_radius
    )
    return loss(coverage, target.masks, target.cams.view_mask)


def view_coverage(
    vertices_world: Float[Array, "*batch vert 3"],
    faces: Int[Array, "face 3"],
    cams: Cameras,
    image_hw: tuple[int, int],
    mask_hw: tuple[int, int],
    *,
    sigma: float | Float[Array, ""] = RELEASE_SIGMA,
    blur_radius: float | Float[Array, ""] | None = RELEASE_BLUR_RADIUS,
) -> Float[Array, "*batch view h w"]:
    """Draw the soft coverage s = -log(1 - alpha) of a mesh in every view.

    Args:
        vertices_world: metres, for example `HandMesh.vertices` after its placement.
        faces: `HandModel.faces`.
        cams: the views; `K` belongs to images of size `image_hw`.
        image_hw: height and width of the images that `K` belongs to.
        mask_hw: height and width to draw; the intrinsics are resized to it.
        sigma: softness, NDC squared.
        blur_radius: squared distance (NDC) at which faces stop to count; None: far out (`soft_silhouette`).

    Returns: s; zeros in masked views.
    """
    cams = fill_masked_views(Cameras(*(jnp.asarray(field) for field in cams)))
    K = resize_intrinsics(cams.K, image_hw, mask_hw)
    uv_px, depth = project(K, cams.T_cam_from_world, jnp.asarray(vertices_world)[..., None, :, :])
    # A mesh behind the camera is not drawn and costs nothing.
    depth = jnp.where(cams.view_mask[..., None], depth, -1)
    return soft_coverage(uv_px, depth, faces, mask_hw, sigma=sigma, blur_radius=blur_radius)


def silhouette_residuals(
    coverage: Float[Array, "*batch view h w"],
    masks: Masks,
    view_mask: Bool[Array, "*batch view"],
) -> Float[Array, "*batch view h w"]:
    """Return alpha - m of every pixel; zero in masked views."""
    masks, valid = _valid_masks(coverage, masks, view_mask)
    return jnp.where(valid, -jnp.expm1(-coverage) - masks, 0)


def silhouette_l1(
    coverage: Float[Array, "*batch view h w"],
    masks: Masks,
    view_mask: Bool[Array, "*batch view"],
) -> Float[Array, "*batch"]:
    """Return the mean of |alpha - m|, the loss of the released code (its weight there is 10).

    Args:
        coverage: from `view_coverage`.
        masks: what was seen, 0..1 or bool.
        view_mask: True for views that exist.

    Raises:
        ValueError: the masks are not of the size that was drawn.
    """
    return _pixel_mean(jnp.abs(silhouette_residuals(coverage, masks, view_mask)), view_mask)


def silhouette_cross_entropy(
    coverage: Float[Array, "*batch view h w"],
    masks: Masks,
    view_mask: Bool[Array, "*batch view"],
) -> Float[Array, "*batch"]:
    """Return the mean of -m log(alpha) - (1 - m) log(1 - alpha), the loss of the paper.

    Logarithms end at `LOG_FLOOR`, and beyond it there is no gradient. log(1 - alpha) = -s is exact also where
    alpha rounds to 1. Arguments and errors are those of `silhouette_l1`.
    """
    masks, valid = _valid_masks(coverage, masks, view_mask)
    covered = coverage > jnp.finfo(coverage.dtype).tiny
    log_alpha = jnp.log(-jnp.expm1(-jnp.where(covered, coverage, 1)))
    log_alpha = jnp.maximum(jnp.where(covered, log_alpha, LOG_FLOOR), LOG_FLOOR)
    log_clear = jnp.maximum(-coverage, LOG_FLOOR)
    entropy = -masks * log_alpha - (1 - masks) * log_clear
    return _pixel_mean(jnp.where(valid, entropy, 0), view_mask)


def _valid_masks(coverage: Array, masks: Array, view_mask: Array) -> tuple[Array, Array]:
    """Return the masks as numbers, zero in masked views, and the view mask per pixel."""
    if masks.shape[-2:] != coverage.shape[-2:]:
        raise ValueError(
            f"`masks` must be of the size that was drawn, {coverage.shape[-2:]}; got {masks.shape[-2:]}"
        )
    valid = jnp.asarray(view_mask)[..., None, None]
    return jnp.where(valid, jnp.asarray(masks).astype(coverage.dtype), 0), valid


def _pixel_mean(values: Array, view_mask: Array) -> Array:
    """Average over valid views and all pixels; `values` are zero in masked views."""
    num_views = jnp.maximum(jnp.asarray(view_mask).sum(-1), 1)
    return values.mean((-2, -1)).sum(-1) / num_views.astype(values.dtype)
