"""Soft silhouettes of triangle meshes, differentiable in the vertices (Liu et al. 2019, Soft Rasterizer).

Convention, as in PyTorch3D's `SoftSilhouetteShader`: the distance d between a pixel's centre and a projected
face is *squared*, measured in NDC (the shorter side of the image spans [-1, 1], so a pixel of a 128 px image
is 1 / 64 wide), negative inside the face. A face hides the pixel with probability sigmoid(-d / sigma); all
faces count, whether or not others are before them:

    alpha = 1 - prod_faces (1 - sigmoid(-d / sigma)) = 1 - exp(-s),    s = sum_faces softplus(-d / sigma).

`sigma` has the unit of d, NDC squared. Faces further than `blur_radius` (of the same unit) from a pixel, of
an area below `MIN_AREA` or with a corner behind the camera do not count. The released fitting uses
`RELEASE_SIGMA` and `RELEASE_BLUR_RADIUS` at 128 px and keeps the 100 nearest faces of a pixel; here all are
kept.

Work is done only where it matters: a face is paired with the 8 x 8 pixel tiles that its box, grown by the
blur radius, touches, and the pairs of all images are walked in chunks of fixed size. The walk is a
`while_loop`, so nothing is dropped however large the faces are; it has its own reverse-mode derivative (and
for that reason no forward-mode one). Where a face is seen edge-on, its area passes `MIN_AREA` and the image
jumps a little; the gradient is that of either side.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.geometry.cameras import pixel_centres
from poem_jax.typing import Array, Float, Int

TILE = 8
"""Side of a tile in pixels."""

CHUNK = 512
"""Pairs of a face and a tile that are worked on at once; small enough for the cache."""

MIN_AREA = 1e-8
"""Twice the area, NDC squared, below which a projected face does not count (PyTorch3D's kEpsilon)."""

MAX_NDC = 1e6
"""Faces with a corner further out than this do not count: float32 could not tell where they lie."""

RELEASE_SIGMA = 1e-6
RELEASE_BLUR_RADIUS = math.log(1e4 - 1) * RELEASE_SIGMA
"""Where a face's probability has fallen to 1e-4."""

BLUR_SIGMAS = math.log(1e8)
"""Default blur radius in units of sigma: where a face's probability has fallen to 1e-8."""


def soft_silhouette(
    uv_px: Float[Array, "*batch vert 2"],
    depth: Float[Array, "*batch vert"],
    faces: Int[Array, "face 3"],
    hw: tuple[int, int],
    *,
    sigma: float | Float[Array, ""] = 1e-4,
    blur_radius: float | Float[Array, ""] | None = None,
    near: float = 1e-3,
) -> Float[Array, "*batch h w"]:
    """Return alpha, the soft silhouette in [0, 1] of every image; see the module for the convention.

    Args:
        uv_px: projected vertices in pixels; the image spans [0, W] x [0, H].
        depth: along the optical axis, metres; only compared with `near`, without gradient.
        faces: rows of vertex indices.
        hw: height and width of the images, static.
        sigma: softness, NDC squared; may be traced (annealed), has no gradient.
        blur_radius: squared distance (NDC) from which on a face does not count; None: `BLUR_SIGMAS * sigma`.
        near: a face with a corner nearer than this (metres), not finite or beyond `MAX_NDC` does not count.

    Returns: alpha. Faces that do not count neither change it nor receive a gradient.

    Raises:
        ValueError: `hw` is not positive, or `uv_px` and `depth` differ in shape.
    """
    return -jnp.expm1(
        -soft_coverage(uv_px, depth, faces, hw, sigma=sigma, blur_radius=blur_radius, near=near)
    )


def soft_coverage(
    uv_px: Float[Array, "*batch vert 2"],
    depth: Float[Array, "*batch vert"],
    faces: Int[Array, "face 3"],
    hw: tuple[int, int],
    *,
    sigma: float | Float[Array, ""] = 1e-4,
    blur_radius: float | Float[Array, ""] | None = None,
    near: float = 1e-3,
) -> Float[Array, "*batch h w"]:
    """Return s = -log(1 - alpha) >= 0, which stays exact where alpha rounds to 1; see `soft_silhouette`."""
    if min(hw) < 1:
        raise ValueError(f"`hw` must be positive; got {hw}")
    if uv_px.shape[:-1] != depth.shape:
        raise ValueError(f"`depth` must have shape {uv_px.shape[:-1]}, as `uv_px` has; got {depth.shape}")
    batch = depth.shape[:-1]
    uv_px, depth, faces = jnp.asarray(uv_px), jnp.asarray(depth), jnp.asarray(faces)
    points = _ndc_from_pixels(uv_px, hw)
    seen = (depth >= near) & (jnp.abs(points) < MAX_NDC).all(-1)
    points = jnp.where(seen[..., None], points, 0)
    corners = points[..., faces, :].reshape(-1, 3, 2)
    counts = seen[..., faces].all(-1).reshape(-1)
    radius = BLUR_SIGMAS * sigma if blur_radius is None else blur_radius
    scales = jnp.stack([jnp.asarray(sigma, corners.dtype), jnp.asarray(radius, corners.dtype)])
    coverage: Array = _coverage(corners, counts, scales, math.prod(batch), hw)
    return coverage.reshape(*batch, *hw)


def _ndc_from_pixels(uv_px: Array, hw: tuple[int, int]) -> Array:
    """Map pixels to NDC: the origin at the image's centre, the shorter side two units long."""
    return (2 * uv_px - np.array([hw[1], hw[0]], dtype=uv_px.dtype)) / min(hw)


class _Pairs(NamedTuple):
    """Every (face, tile) pair, in order of faces: face f owns pairs `end[f] - count .. end[f]`."""

    end: Int[Array, "face"]
    first: Int[Array, "face 2"]
    """Column and row of the first tile of each face's rectangle of tiles."""
    size: Int[Array, "face 2"]
    """Columns and rows of that rectangle; zero for faces that do not count."""


def _pair_up(corners: Array, counts: Array, scales: Array, hw: tuple[int, int]) -> _Pairs:
    """Find the tiles that hold pixel centres within the blur radius of each face's bounding box."""
    wh = np.array([hw[1], hw[0]], dtype=np.int32)
    half = min(hw) / 2
    # One hundredth of a pixel more than needed: rounding must not lose a centre that lies on the rim.
    reach = jnp.sqrt(scales[1]) * half + 0.01
    # Far-off corners are clamped before the cast, or they would overflow an integer.
    low = jnp.clip(corners.min(-2) * half + wh / 2 - reach - 0.5, -1, wh).astype(corners.dtype)
    high = jnp.clip(corners.max(-2) * half + wh / 2 + reach - 0.5, -1, wh).astype(corners.dtype)
    first = jnp.maximum(jnp.ceil(low).astype(jnp.int32), 0)
    last = jnp.minimum(jnp.floor(high).astype(jnp.int32), wh - 1)
    edge_ab, edge_ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    alive = counts & (jnp.abs(_cross(edge_ab, edge_ac)) > MIN_AREA) & (last >= first).all(-1)
    size = jnp.where(alive[:, None], last // TILE - first // TILE + 1, 0)
    return _Pairs(jnp.cumsum(size[:, 0] * size[:, 1], dtype=jnp.int32), first // TILE, size)


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _chunk_of(pairs: _Pairs, start: Array, num_images: int, hw: tuple[int, int]) -> tuple[Array, ...]:
    """Return faces, tiles (numbered through all images) and tile positions of `CHUNK` pairs from `start` on.

    Pairs past the end get face and tile numbers that are out of range.
    """
    num_faces = len(pairs.end)
    number = start + jnp.arange(CHUNK, dtype=jnp.int32)
    face = jnp.searchsorted(pairs.end, number, side="right").astype(jnp.int32)
    owner = jnp.minimum(face, num_faces - 1)
    columns = jnp.maximum(pairs.size[owner, 0], 1)
    within = number - (pairs.end[owner] - pairs.size[owner, 0] * pairs.size[owner, 1])
    position = pairs.first[owner] + jnp.stack([within % columns, within // columns], axis=-1)
    tiles_wide, tiles_high = -(-hw[1] // TILE), -(-hw[0] // TILE)
    image = owner // (num_faces // num_images)
    tile = (image * tiles_high + position[:, 1]) * tiles_wide + position[:, 0]
    past = face >= num_faces
    return face, jnp.where(past, num_images * tiles_high * tiles_wide, tile), position


class _Nearest(NamedTuple):
    """The point of a face's outline that is nearest to a pixel: p - sum_k weights[k] * corner[k] = offset."""

    distance: Array
    """Signed squared distance: negative inside."""
    weights: tuple[Array, Array, Array]
    offset: tuple[Array, Array]
    inside: Array


def _nearest(corners: Array, pixels: tuple[Array, Array]) -> _Nearest:
    """Find the outline's nearest point; `corners` (pair 3 2), `pixels` x and y (pair pixel)."""
    squared, places, offsets, sides = [], [], [], []
    for k in range(3):
        start, edge = corners[:, k, :, None], (corners[:, (k + 1) % 3] - corners[:, k])[..., None]
        length = edge[:, 0] ** 2 + edge[:, 1] ** 2
        x, y = pixels[0] - start[:, 0], pixels[1] - start[:, 1]
        place = jnp.clip((x * edge[:, 0] + y * edge[:, 1]) / jnp.where(length > 0, length, 1), 0, 1)
        offset = x - place * edge[:, 0], y - place * edge[:, 1]
        squared.append(offset[0] ** 2 + offset[1] ** 2)
        places.append(place)
        offsets.append(offset)
        sides.append(edge[:, 0] * y - edge[:, 1] * x)
    inside = ((sides[0] >= 0) & (sides[1] >= 0) & (sides[2] >= 0)) | (
        (sides[0] <= 0) & (sides[1] <= 0) & (sides[2] <= 0)
    )
    first = (squared[0] <= squared[1]) & (squared[0] <= squared[2])
    second = ~first & (squared[1] <= squared[2])

    def chosen(a: Array, b: Array, c: Array) -> Array:
        return jnp.where(first, a, jnp.where(second, b, c))

    distance = chosen(*squared)
    weights = (
        chosen(1 - places[0], jnp.zeros_like(places[1]), places[2]),
        chosen(places[0], 1 - places[1], jnp.zeros_like(places[2])),
        chosen(jnp.zeros_like(places[0]), places[1], 1 - places[2]),
    )
    offset = chosen(*(o[0] for o in offsets)), chosen(*(o[1] for o in offsets))
    return _Nearest(jnp.where(inside, -distance, distance), weights, offset, inside)


def _tile_pixels(position: Array, hw: tuple[int, int], dtype: np.dtype) -> tuple[Array, Array]:
    """Return x and y (pair pixel) of the pixel centres of tiles in NDC."""
    centres = pixel_centres((TILE, TILE), dtype.type).reshape(-1, 2)
    uv_px = position[:, None].astype(dtype) * TILE + centres
    ndc = _ndc_from_pixels(uv_px, hw)
    return ndc[..., 0], ndc[..., 1]


def _to_tiles(image: Array, hw: tuple[int, int]) -> Array:
    """Cut images (image, h, w) into tiles (image * tile, pixel), zero beyond their edges."""
    padded = jnp.pad(image, ((0, 0), (0, -hw[0] % TILE), (0, -hw[1] % TILE)))
    n, h, w = padded.shape
    cut = padded.reshape(n, h // TILE, TILE, w // TILE, TILE).transpose(0, 1, 3, 2, 4)
    return cut.reshape(-1, TILE * TILE)


def _from_tiles(tiles: Array, num_images: int, hw: tuple[int, int]) -> Array:
    """Put the images back together; the inverse of `_to_tiles`."""
    h, w = -(-hw[0] // TILE), -(-hw[1] // TILE)
    image = tiles.reshape(num_images, h, w, TILE, TILE).transpose(0, 1, 3, 2, 4)
    return image.reshape(num_images, h * TILE, w * TILE)[:, : hw[0], : hw[1]]


def _softplus(x: Array) -> Array:
    return jnp.maximum(x, 0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


@partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _coverage(corners: Array, counts: Array, scales: Array, num_images: int, hw: tuple[int, int]) -> Array:
    """Sum softplus(-d / sigma) over the faces of each image; `scales` = sigma, blur radius."""
    pairs = _pair_up(corners, counts, scales, hw)
    num_tiles = num_images * -(-hw[0] // TILE) * -(-hw[1] // TILE)

    def add_chunk(state: tuple[Array, Array]) -> tuple[Array, Array]:
        start, total = state
        face, tile, position = _chunk_of(pairs, start, num_images, hw)
        near = _nearest(corners[face], _tile_pixels(position, hw, corners.dtype))
        hidden = jnp.where(near.distance < scales[1], _softplus(-near.distance / scales[0]), 0)
        return start + CHUNK, total.at[tile].add(hidden, mode="drop")

    start = jnp.zeros((), jnp.int32), jnp.zeros((num_tiles, TILE * TILE), corners.dtype)
    total = jax.lax.while_loop(lambda state: state[0] < pairs.end[-1], add_chunk, start)[1]
    return _from_tiles(total, num_images, hw)


def _coverage_forward(
    corners: Array, counts: Array, scales: Array, num_images: int, hw: tuple[int, int]
) -> tuple[Array, tuple[Array, Array, Array]]:
    return _coverage(corners, counts, scales, num_images, hw), (corners, counts, scales)


def _coverage_backward(
    num_images: int, hw: tuple[int, int], saved: tuple[Array, Array, Array], cotangent: Array
) -> tuple[Array, None, Array]:
    """Walk the pairs again. The nearest point minimises the distance, so its weights may be held fixed:
    d = +-|offset|^2 has the derivative -+2 weights[k] offset with respect to corner k."""
    corners, counts, scales = saved
    pairs = _pair_up(corners, counts, scales, hw)
    wanted = _to_tiles(cotangent, hw)

    def add_chunk(state: tuple[Array, Array]) -> tuple[Array, Array]:
        start, gradient = state
        face, tile, position = _chunk_of(pairs, start, num_images, hw)
        near = _nearest(corners[face], _tile_pixels(position, hw, corners.dtype))
        rate = jax.nn.sigmoid(-near.distance / scales[0]) * (2 / scales[0])
        rate = jnp.where(near.inside, -rate, rate) * wanted[tile]
        rate = jnp.where(near.distance < scales[1], rate, 0)
        x, y = rate * near.offset[0], rate * near.offset[1]
        parts = jnp.stack([(w * o).sum(-1) for w in near.weights for o in (x, y)], axis=-1)
        return start + CHUNK, gradient.at[face].add(parts.reshape(CHUNK, 3, 2), mode="drop")

    start = jnp.zeros((), jnp.int32), jnp.zeros_like(corners)
    gradient = jax.lax.while_loop(lambda state: state[0] < pairs.end[-1], add_chunk, start)[1]
    return gradient, None, jnp.zeros_like(scales)


_coverage.defvjp(_coverage_forward, _coverage_backward)
