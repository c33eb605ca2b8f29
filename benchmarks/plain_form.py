"""The plain form of POEM v2: the same function as `poem_jax.models`, with nothing done for speed.

The opponent of `benchmarks/inference.py`, and the learned half of an oracle of the tests. It is written as
the paper's equations read and as one first writes JAX: every convolution is `lax.conv_general_dilated`, batch
norm is written out, residual blocks follow one by one, attention has its heads inside, vector attention makes
whole (batch, query, k, c) arrays, and neighbours come from one `lax.top_k`.

Cameras, triangulation, bilinear sampling and the hand in `plain_forward` are those of `poem_jax`: they are
not what is optimised, so as an oracle it says nothing of them. `tests/models/test_plain_form.py` puts NumPy
in their place between the learned parts (`plain_views`, `plain_aggregation`, `plain_decoder`); of `poem_jax`
the hand model and its posing by joints remain, which have tests of their own.

It takes the same `params` and `Config`, and batches in which every view is valid: no masks, no training.

Letters: w = the weights of one part, its running statistics among them; i = image = (batch, view).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from poem_jax.geometry.cameras import Cameras, anchor_to_primary, project
from poem_jax.geometry.neighbours import gather
from poem_jax.geometry.sampling import sample_bilinear
from poem_jax.geometry.transforms import invert_rigid, rotation_from_6d, transform_points
from poem_jax.geometry.triangulation import triangulate
from poem_jax.hand.model import HandModel
from poem_jax.hand.topology import NUM_JOINTS, NUM_SKELETON_JOINTS, ROOT_JOINT, join_queries, split_queries
from poem_jax.models.config import (
    Config,
    DecoderConfig,
    DecoderOutput,
    Design,
    FirstQueries,
    HeatActivation,
    HRNetConfig,
    NeighbourSearch,
    Similarity,
    Stem,
    ViewWeights,
)
from poem_jax.models.hand_output import HandParameters, pose_by_joints, root_relative_mesh
from poem_jax.models.layers import BATCH_NORM_EPSILON
from poem_jax.typing import Array, Bool, Float, Int, Num, Params

_TEMPERATURE = 10000.0
_FALLBACK_ROOT = (0.0, 0.0, 0.5)

Weights = dict[str, Any]
IndexSets = list[Int[Array, "batch query k"]]
"""What the searches found, in order: layer by layer the basis points and, if these are read, the queries."""


class PlainResult(NamedTuple):
    """What `poem_jax.forward` predicts, as far as it comes from the network; frames and units as there."""

    layers: Float[Array, "batch layer query 3"]
    """World, metres, in the order of the config."""
    keypoints_px: Float[Array, "batch view joint 2"]
    heat_maps: Float[Array, "batch view joint h w"]
    root: Float[Array, "batch 3"]
    """World, metres."""


def plain_forward(
    params: Params,
    images: Num[Array, "batch view h w 3"],
    cams: Cameras,
    config: Config,
    root: Float[Array, "batch 3"] | None = None,
    neighbours: IndexSets | None = None,
) -> tuple[PlainResult, IndexSets]:
    """Compute what `poem_jax.models.network.forward` does at inference for views that are all valid.

    Args:
        params: as there.
        images: as there.
        cams: as there; `view_mask` is not looked at.
        config: static under `jax.jit`.
        root: known roots, world, metres; NaN rows and None are triangulated.
        neighbours: index sets to use instead of searching.

    Returns: the result, and the index sets that were used.
    """
    everything = jnp.ones(cams.K.shape[:2], bool)
    T_cam_from_primary, T_primary_from_world = anchor_to_primary(cams.T_cam_from_world, everything)
    cams = Cameras(cams.K, T_cam_from_primary)
    if root is not None:
        root = transform_points(T_primary_from_world, root[:, None])[:, 0]
    keypoints_px, heat_maps, maps = plain_views(params, images, config)
    joints, solved = _triangulated(keypoints_px, heat_maps, cams, config)
    centre = _root(joints, solved, root)

    tokens = plain_sampling_and_aggregation(params, maps, cams, centre, config)
    places = [joints - centre[:, None]]
    if config.joint_decoder is not None:
        places += plain_joint_decoder(params, places[0], heat_maps, maps, cams, centre, config)
    starts = [plain_start(params, at, solved, config) for at in places]
    start = starts[-1]
    moved, embeddings, found = plain_decoder(params, start, tokens, config, neighbours)
    layers = [config.basis.radius * queries for queries in starts[1:] + moved]
    if config.decoder.output is DecoderOutput.HAND_PARAMETERS:
        layers.append(plain_hand(params, embeddings, config))
    to_world = invert_rigid(T_primary_from_world)
    layers_world = transform_points(to_world[:, None], jnp.stack(layers, 1) + centre[:, None, None])
    root_world = transform_points(to_world, centre[:, None])[:, 0]
    return PlainResult(layers_world, keypoints_px, heat_maps, root_world), found


def plain_views(
    params: Params, images: Num[Array, "batch view h w 3"], config: Config
) -> tuple[
    Float[Array, "batch view joint 2"],
    Float[Array, "batch view joint h w"],
    Float[Array, "batch view h w c"],
]:
    """Return what is computed of every view alone: key points in pixels, heat maps, feature maps."""
    dtype = params["constants"]["basis_points"].dtype
    levels = plain_trunk(params, normalised(images, config, dtype), config)
    keypoints_px, heat_maps = plain_heat_maps(params, levels, config)
    of_images = (keypoints_px, heat_maps, plain_features(params, levels, heat_maps, config))
    keypoints_px, heat_maps, maps = (_by_view(x, images) for x in of_images)
    return keypoints_px, heat_maps, maps


def normalised(
    images: Num[Array, "batch view h w 3"], config: Config, dtype: DTypeLike
) -> Float[Array, "image h w 3"]:
    """Return all images in a row, as the trunk takes them."""
    scale = 255.0 if images.dtype == jnp.uint8 else 1.0
    flat = images.reshape(-1, *images.shape[2:]).astype(dtype)
    return (flat / scale - config.image_mean) / config.image_std


# The trunk.


def plain_trunk(params: Params, images: Float[Array, "image h w 3"], config: Config) -> list[Array]:
    """Return the trunk's maps, finest first."""
    w = _weights(params)["trunk"]
    return _hrnet(images, w) if isinstance(config.backbone, HRNetConfig) else _resnet(images, w, config)


def _hrnet(x: Array, w: Weights) -> list[Array]:
    for conv in _rows(w["stem"]):
        x = _conv_norm(x, conv, stride=2)
    x = _residual(x, w["widen"])
    for block in _unstacked(w["layer1"]["blocks"]):
        x = _residual(x, block)
    fine, coarse = _rows(w["transition1"])
    maps = [_conv_norm(x, fine), _conv_norm(x, coarse, stride=2)]
    for stage, transition in (("stage2", "transition2"), ("stage3", "transition3"), ("stage4", None)):
        for module in _unstacked(w[stage]["blocks"]):
            maps = _exchange(maps, module)
        if transition is not None:
            maps = [*maps, _conv_norm(maps[-1], w[transition], stride=2)]
    return maps


def _exchange(maps: list[Array], w: Weights) -> list[Array]:
    """Run the blocks of every branch, then sum all branches into each."""
    through = []
    for x, branch in zip(maps, _rows(w["branches"]), strict=True):
        for block in _unstacked(branch["blocks"]):
            x = _residual(x, block)
        through.append(x)
    return [_fused(through, target, fuse) for target, fuse in enumerate(_rows(w["fuse"]))]


def _fused(maps: list[Array], target: int, w: Weights) -> Array:
    total = maps[target]
    sources = [source for source in range(len(maps)) if source != target]
    for source, path in zip(sources, _rows(w["paths"]), strict=True):
        x = maps[source]
        if source > target:
            factor = 2 ** (source - target)
            x = _conv_norm(x, path["conv"], relu=False)
            total = total + jnp.repeat(jnp.repeat(x, factor, axis=1), factor, axis=2)
        else:
            *keep, last = _rows(path["convs"])
            for conv in keep:
                x = _conv_norm(x, conv, stride=2)
            total = total + _conv_norm(x, last, stride=2, relu=False)
    return jax.nn.relu(total)


def _resnet(x: Array, w: Weights, config: Config) -> list[Array]:
    if config.backbone.stem is Stem.CONVOLUTION:  # pyright: ignore[reportAttributeAccessIssue]
        x = _max_pool(_conv_norm(x, w["stem"]["conv"], stride=2), 3, 2, 1)
    else:
        image, h, width, c = x.shape
        cells = x.reshape(image, h // 4, 4, width // 4, 4, c).transpose(0, 1, 3, 2, 4, 5)
        x = _conv_norm(cells.reshape(image, h // 4, width // 4, 16 * c), w["stem"]["conv"])
    levels = []
    for i, stage in enumerate(_rows(w["stages"])):
        for j, block in enumerate(_rows(stage["blocks"])):
            x = _residual(x, block, stride=2 if i > 0 and j == 0 else 1)
        levels.append(x)
    return levels


def _residual(x: Array, w: Weights, stride: int = 1) -> Array:
    """Apply a basic block or a bottleneck (He et al. 2016)."""
    if "middle" in w:
        y = _conv_norm(_conv_norm(x, w["reduce"]), w["middle"], stride=stride)
        y = _conv_norm(y, w["expand"], relu=False)
    else:
        y = _conv_norm(_conv_norm(x, w["first"], stride=stride), w["second"], relu=False)
    shortcut = _conv_norm(x, w["shortcut"], stride=stride, relu=False) if "shortcut" in w else x
    return jax.nn.relu(y + shortcut)


def _conv_norm(x: Array, w: Weights, *, stride: int = 1, relu: bool = True) -> Array:
    y, norm = _conv(x, w["conv"], stride), w["norm"]
    y = (y - norm["mean"]) / jnp.sqrt(norm["variance"] + BATCH_NORM_EPSILON) * norm["scale"] + norm["bias"]
    return jax.nn.relu(y) if relu else y


def _conv(x: Array, w: Weights, stride: int = 1) -> Array:
    pad = (w["kernel"].shape[0] - 1) // 2
    y = jax.lax.conv_general_dilated(
        x, w["kernel"], (stride, stride), [(pad, pad)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    return y + w["bias"] if "bias" in w else y


# The 2D branches.


def plain_heat_maps(
    params: Params, levels: list[Array], config: Config
) -> tuple[Float[Array, "image joint 2"], Float[Array, "image joint h w"]]:
    """Return the joints in pixels, and the heat maps whose expectation they are (paper, eq. 3)."""
    w, root = _weights(params)["heat_maps"], config.root
    x = _top_down(levels, w.get("branch", {}), config.backbone.strides.index(root.branch_stride))
    logits = _conv(_max_pool(x, root.pooling, root.pooling), w["to_logits"]).transpose(0, 3, 1, 2)
    heat = jnp.exp(logits) if root.activation is HeatActivation.SOFTMAX else jax.nn.sigmoid(logits)
    total = jnp.sum(heat, (-2, -1))
    rows, columns = (root.stride * (jnp.arange(size) + root.cell_offset) for size in heat.shape[-2:])
    u, v = jnp.einsum("ijhw,w->ij", heat, columns), jnp.einsum("ijhw,h->ij", heat, rows)
    keypoints_px = jnp.stack([u, v], -1) / (total[..., None] + root.sum_epsilon)
    return keypoints_px, heat / total[..., None, None]


def plain_features(
    params: Params, levels: list[Array], heat_maps: Array, config: Config
) -> Float[Array, "image h w c"]:
    """Return the maps that the basis points sample, without the position code."""
    w = _weights(params)["features"]
    if config.features.design is Design.PAPER:
        x = _top_down(levels, w.get("branch", {}), config.backbone.strides.index(config.features.stride))
    else:
        x = levels[0]
        for reduce, coarser in zip(_rows(w["branch"]["reductions"]), levels[1:], strict=True):
            x = _conv_norm(x, reduce, stride=2) + coarser
        x = _conv(_doubled(x), w["branch"]["squeeze"])
    if config.features.heat_maps:
        cells = heat_maps.shape[-2] * heat_maps.shape[-1]
        evidence = jnp.log(cells * heat_maps + 0.01) / 4
        x = jnp.concatenate([x, evidence.transpose(0, 2, 3, 1)], -1)
    return _conv(x, w["project"])


def _top_down(levels: list[Array], w: Weights, finest: int) -> Array:
    x, *finer_ones = levels[finest:][::-1]
    for merge, finer in zip(_rows(w.get("merges", {})), finer_ones, strict=True):
        x = _conv_norm(jnp.concatenate([_doubled(x), finer], -1), merge)
    return x


def _doubled(x: Array) -> Array:
    image, h, w, c = x.shape
    return jax.image.resize(x, (image, 2 * h, 2 * w, c), "bilinear")


def _max_pool(x: Array, size: int, stride: int, pad: int = 0) -> Array:
    padding = ((0, 0), (pad, pad), (pad, pad), (0, 0))
    return jax.lax.reduce_window(
        x, -jnp.inf, jax.lax.max, (1, size, size, 1), (1, stride, stride, 1), padding
    )


# From the views to the basis points.


def plain_sampling_and_aggregation(
    params: Params,
    maps: Float[Array, "batch view h w c"],
    cams: Cameras,
    root: Float[Array, "batch 3"],
    config: Config,
) -> Float[Array, "batch basis c"]:
    """Return the features of the basis points about `root`; all in the primary camera's frame."""
    maps = plain_map_position(params, maps, config)
    points = root[:, None] + params["constants"]["basis_points"]
    uv_px, depth = project(cams.K, cams.T_cam_from_world, points[:, None])
    share = uv_px / jnp.array(config.image_hw[::-1], uv_px.dtype)
    sampled = sample_bilinear(maps, share * jnp.array(maps.shape[-3:-1][::-1], uv_px.dtype))
    if config.features.design is Design.PAPER:
        seen = (depth > 0)[..., None]
        sampled, share = jnp.where(seen, sampled, 0), jnp.where(seen, share, 0)
    return plain_aggregation(params, sampled, share, config)


def plain_map_position(
    params: Params, maps: Float[Array, "batch view h w c"], config: Config
) -> Float[Array, "batch view h w c"]:
    """Add the position code to the feature maps, if it belongs there."""
    if config.features.design is Design.PAPER:
        return maps
    return maps + _view_row_column_code(_weights(params)["features"]["position"]["mix"], maps.shape)


def plain_aggregation(
    params: Params,
    sampled: Float[Array, "batch view basis c"],
    share: Float[Array, "batch view basis 2"],
    config: Config,
) -> Float[Array, "batch basis c"]:
    """f1 + phi(sum_j theta(f1) . theta(fj) theta(fj)) / N (paper, eq. 7-8); f = sampled features.

    `share` holds the projections as (u / W, v / H), whose code is added to the features if it belongs there.
    """
    w = _weights(params)["aggregation"]
    if config.features.design is Design.PAPER:
        sampled = sampled + _sine_code(share, sampled.shape[-1])
    batch, views, points, c = sampled.shape
    if config.aggregation.design is Design.RELEASE:
        tokens = sampled.transpose(0, 1, 3, 2).reshape(batch, points, views, c)
    else:
        tokens = sampled.transpose(0, 2, 1, 3)
    theta = _two_layers(tokens, w["theta_in"], w["theta_out"])
    if config.aggregation.similarity is Similarity.EQUAL:
        return tokens.mean(2) + _two_layers(theta.mean(2), w["phi_in"], w["phi_out"])
    first, sources = theta[:, :, 0], theta[:, :, 1:]
    similarity = jnp.einsum("bnc,bnvc->bnv", first, sources)
    if config.aggregation.similarity is Similarity.MEAN:
        similarity = similarity / theta.shape[-1]
    mixed = jnp.einsum("bnv,bnvc->bnc", similarity, sources)
    if views == 1:
        if config.aggregation.design is Design.PAPER:
            return tokens[:, :, 0]
        mixed = first
    return tokens[:, :, 0] + _two_layers(mixed, w["phi_in"], w["phi_out"]) / views


def _view_row_column_code(w: Weights, shape: tuple[int, ...]) -> Float[Array, "view h w c"]:
    """Mix sines and cosines of the numbers of view, row and column (release)."""
    _, *sizes, c = shape
    codes = []
    for axis, size in enumerate(sizes):
        angle = 2 * jnp.pi * (jnp.arange(size) + 1.0) / (size + 1e-6)
        angle = angle[:, None] / _TEMPERATURE ** (2 * jnp.arange(c // 4) / (c // 2))
        code = jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], -1)
        along = [code.shape[0] if i == axis else 1 for i in range(3)]
        codes.append(jnp.broadcast_to(code.reshape(*along, c // 2), (*sizes, c // 2)))
    return _conv(jnp.concatenate(codes, -1), w)


def _sine_code(share: Float[Array, "*batch 2"], width: int) -> Float[Array, "*batch c"]:
    """Encode (u / W, v / H) by sines, v first (Carion et al. 2020)."""
    half = width // 2
    angle = 2 * jnp.pi * share[..., ::-1, None] * _TEMPERATURE ** (-2.0 * jnp.arange(half // 2) / half)
    return jnp.stack([jnp.sin(angle), jnp.cos(angle)], -1).reshape(*share.shape[:-1], width)


# The root, and where the query points start.


def _triangulated(
    uv_px: Array, heat: Array, cams: Cameras, config: Config
) -> tuple[Float[Array, "batch joint 3"], Array]:
    weights = None
    if config.root.view_weights is ViewWeights.HEAT_SPREAD:
        cells = uv_px / config.root.stride - config.root.cell_offset
        h, w = heat.shape[-2:]
        off_u, off_v = jnp.arange(w) - cells[..., :1], jnp.arange(h) - cells[..., 1:]
        squares = off_u[..., None, :] ** 2 + off_v[..., :, None] ** 2
        weights = 1 / jnp.maximum(jnp.sum(heat * squares, (-2, -1)), 0.25)
    K, T = cams.K, cams.T_cam_from_world
    joints, solved = triangulate(uv_px, K, T, weights, normalise_rows=config.root.design is Design.PAPER)
    _, depth = project(K, T, joints[:, None])
    return joints, solved & jnp.all(depth > 0, 1)


def _root(joints: Array, solved: Array, known: Array | None) -> Float[Array, "batch 3"]:
    index = ROOT_JOINT if joints.shape[1] == NUM_JOINTS else 0
    root = jnp.where(solved[:, index, None], joints[:, index], jnp.array(_FALLBACK_ROOT))
    if known is None:
        return root
    return jnp.where(jnp.all(jnp.isfinite(known), -1, keepdims=True), known, root)


def plain_start(
    params: Params,
    joints: Float[Array, "batch joint 3"],
    solved: Bool[Array, "batch joint"],
    config: Config,
) -> Float[Array, "batch query 3"]:
    """Return the query points before the first layer, basis radii about the root; `joints` in metres."""
    template, order = params["constants"]["template_queries"], config.decoder.query_order
    posed = jnp.broadcast_to(template, (joints.shape[0], *template.shape))
    if config.decoder.first_queries is FirstQueries.JOINTS:
        length = jnp.maximum(jnp.linalg.norm(joints, axis=-1, keepdims=True), 1e-6)
        joints = joints * jnp.minimum(1.0, 1.5 * config.basis.radius / length)
        vertices = pose_by_joints(_hand(params), *split_queries(template, order), joints)
        there = join_queries(vertices, joints, order)
        posed = jnp.where(jnp.all(solved, -1)[:, None, None], there, posed)
    return posed / config.basis.radius


# The joint decoder.


def plain_joint_decoder(
    params: Params,
    joints: Float[Array, "batch 21 3"],
    heat_maps: Float[Array, "batch view 21 h w"],
    maps: Float[Array, "batch view h w c"],
    cams: Cameras,
    centre: Float[Array, "batch 3"],
    config: Config,
) -> list[Float[Array, "batch 21 3"]]:
    """Return the joints after every layer; they, and what is returned, in metres about `centre`."""
    assert config.joint_decoder is not None
    length = jnp.maximum(jnp.linalg.norm(joints, axis=-1, keepdims=True), 1e-6)
    joints = joints * jnp.minimum(1.0, 1.5 * config.basis.radius / length)
    evidence = 0.25 * jnp.log(heat_maps.shape[-2] * heat_maps.shape[-1] * heat_maps + 0.01)
    around = [jnp.zeros((1, 3))]
    for i, radius in enumerate(config.joint_decoder.shells_m):
        corners = jnp.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / jnp.sqrt(3.0)
        around.append(radius * (corners if i % 2 else jnp.concatenate([jnp.eye(3), -jnp.eye(3)])))
    cloud = jnp.concatenate(around)
    places = []
    for w in _rows(_weights(params)["joint_decoder"]["layers"]):
        R = _hand_axes(joints)
        clouds = joints[:, :, None] + jnp.einsum("px,bxy->bpy", cloud, R)[:, None]
        said = jnp.mean(_read(evidence[..., None], clouds + centre[:, None, None], cams, config), 1)[..., 0]
        joint_maps = jnp.broadcast_to(maps[:, :, None], (*maps.shape[:2], 21, *maps.shape[2:]))
        seen = jnp.mean(_read(joint_maps, (joints + centre[:, None])[:, :, None], cams, config), 1)[:, :, 0]
        local = jnp.einsum("bxy,bjy->bjx", R, joints - joints[:, ROOT_JOINT, None]) / config.basis.radius
        tokens = jnp.concatenate([local, said, _linear(seen, w["pick"])], -1)
        x = jnp.einsum("bjn,jnc->bjc", tokens, w["embed"]) + w["names"]
        for block in _rows(w["blocks"]):
            y = _layer_norm(x, block["before_attention"], 1e-5)
            x = x + _attention(y, y, block["attention"], config.joint_decoder.num_heads)
            y = _linear(_layer_norm(x, block["before_hidden"], 1e-5), block["hidden"])
            x = x + _linear(jax.nn.gelu(y), block["out"])
        step = 0.01 * _linear(_layer_norm(x, w["norm"], 1e-5), w["offset"])
        joints = joints + jnp.einsum("bjx,bxy->bjy", step, R)
        places.append(joints)
    return places


def _hand_axes(joints: Float[Array, "batch 21 3"]) -> Float[Array, "batch 3 3"]:
    """Return rows: from the wrist to the knuckles' middle, across them, and the palm's normal."""
    knuckles = joints[:, [5, 9, 13, 17]]
    along = jnp.mean(knuckles, 1) - joints[:, 0]
    along = along / jnp.linalg.norm(along, axis=-1, keepdims=True)
    across = jnp.einsum("k,bkx->bx", jnp.array([1.0, 0.5, -0.5, -1.0]), knuckles)
    across = across - jnp.sum(across * along, -1, keepdims=True) * along
    across = across / jnp.linalg.norm(across, axis=-1, keepdims=True)
    return jnp.stack([along, across, jnp.cross(along, across)], 1)


def _read(
    maps: Float[Array, "batch view joint h w c"],
    points: Float[Array, "batch joint point 3"],
    cams: Cameras,
    config: Config,
) -> Float[Array, "batch view joint point c"]:
    """Sample the map of every joint where its points project; behind a camera there are zeros."""
    K, T = (x[:, :, None] for x in (cams.K, cams.T_cam_from_world))
    uv, depth = project(K, T, points[:, None])
    cells = uv / jnp.array(config.image_hw[::-1]) * jnp.array(maps.shape[-3:-1][::-1])
    return jnp.where((depth > 0)[..., None], sample_bilinear(maps, cells), 0)


# The decoder.


def plain_decoder(
    params: Params,
    queries: Float[Array, "batch query 3"],
    features: Float[Array, "batch basis c"],
    config: Config,
    neighbours: IndexSets | None = None,
) -> tuple[list[Float[Array, "batch query 3"]], Float[Array, "batch query c"], IndexSets]:
    """Return the query points after every layer that moves them, the last embeddings, and the index sets.

    Coordinates are in basis radii about the root.
    """
    w, decoder = _weights(params)["decoder"], config.decoder
    points = params["constants"]["basis_points"] / config.basis.radius
    points = jnp.broadcast_to(points, (len(queries), *points.shape))
    e = jnp.broadcast_to(w["embeddings"], (len(queries), *w["embeddings"].shape))
    if decoder.embed_coordinates:
        features = features + _two_layers(points, w["locate"]["hidden"], w["locate"]["out"])
    given, found, moved, around = iter(neighbours or []), [], [], []
    for i, layer in enumerate(_rows(w["layers"])):
        clouds = [points, queries] if decoder.layer is Design.RELEASE else [points]
        if i == 0 and decoder.layer is Design.RELEASE:
            around = [_anchors(params, queries)] * len(clouds)
        elif i == 0 or decoder.neighbour_search is NeighbourSearch.EVERY_LAYER:
            sets = [next(given) if neighbours else _nearest(queries, c, decoder) for c in clouds]
            around = [(index, gather(cloud, index)) for index, cloud in zip(sets, clouds, strict=True)]
            found += sets
        if decoder.embed_coordinates:
            e = e + _two_layers(queries, w["locate"]["hidden"], w["locate"]["out"])
        e, queries = _layer(e, queries, features, around, layer, decoder)
        moved.append(queries)
    parametric = decoder.output is DecoderOutput.HAND_PARAMETERS
    return moved[:-1] if parametric else moved, e, found


def _nearest(queries: Array, points: Array, decoder: DecoderConfig) -> Int[Array, "batch query k"]:
    distance = jnp.sum((queries[:, :, None] - points[:, None]) ** 2, -1)
    return jax.lax.top_k(-distance, decoder.num_neighbours)[1]


def _anchors(params: Params, queries: Array) -> tuple[Array, Array]:
    """Return the rows and positions that every query reads in the first layer."""
    index, positions = (params["constants"]["anchors"][name] for name in ("index", "positions"))
    shape = (*queries.shape[:2], len(index))
    return jnp.broadcast_to(index, shape), jnp.broadcast_to(positions, (*shape, 3))


def _layer(
    e: Array, x: Array, features: Array, around: list, w: Weights, decoder: DecoderConfig
) -> tuple[Array, Array]:
    epsilon, norms = 1e-12 if decoder.layer is Design.RELEASE else 1e-5, _rows(w["norms"])
    if decoder.layer is Design.RELEASE:
        e, features = _linear(e, w["embed"]), _linear(features, w["embed"])
    basis = features[:, :: decoder.cross_attention_basis_stride]
    read = e if decoder.layer is Design.PAPER else basis
    e = _layer_norm(e + _attention(e, read, w["self_attention"], decoder.num_heads), norms[0], epsilon)
    e = _layer_norm(e + _attention(e, basis, w["cross_attention"], decoder.num_heads), norms[1], epsilon)
    vector, near = w["vector_attention"], around[0]
    if decoder.layer is Design.PAPER:
        e = _layer_norm(e + _vector_attention(e, x, features, near, vector), norms[2], epsilon)
    else:
        scale, among, to_basis = e.shape[-1] ** -0.5, vector["queries"], vector["basis"]
        mapped = _linear(e, among["before"])
        read = _vector_attention(mapped, x, mapped, around[1], among["attention"], scale)
        e = e + _linear(read, among["after"])
        mapped = _linear(features, to_basis["before"])
        read = _vector_attention(e, x, mapped, near, to_basis["attention"], scale)
        e = e + _linear(read, to_basis["after"])
    if decoder.layer is Design.PAPER:
        moves = "feed_forward" in w
        return e, x + _offsets(e, w["feed_forward"]) if moves else x
    if "branch" in w:
        x = x + _offsets(e, w["branch"])
    if "feed_forward" in w:
        ffn = w["feed_forward"]
        update = _linear(jax.nn.gelu(_linear(e, ffn["hidden"]), approximate=False), ffn["out"])
        e = _layer_norm(e + update, ffn["norm"], epsilon)
    return e, x


def _attention(queries: Array, tokens: Array, w: Weights, heads: int) -> Float[Array, "batch query c"]:
    """softmax(Q K^T / sqrt(d / heads)) V, projected (paper, eq. 10)."""
    q, k, v = (
        _linear(x, w[name]).reshape(*x.shape[:2], heads, -1)
        for x, name in ((queries, "query"), (tokens, "key"), (tokens, "value"))
    )
    logits = jnp.einsum("bqhc,bthc->bhqt", q, k) / jnp.sqrt(q.shape[-1])
    read = jnp.einsum("bhqt,bthc->bqhc", jax.nn.softmax(logits, -1), v)
    return _linear(read.reshape(queries.shape), w["out"])


def _vector_attention(
    e: Float[Array, "batch query c"],
    x: Float[Array, "batch query 3"],
    features: Float[Array, "batch point c"],
    neighbours: tuple[Int[Array, "batch query k"], Float[Array, "batch query k 3"]],
    w: Weights,
    scale: float = 1.0,
) -> Float[Array, "batch query c"]:
    """sum_j softmax_j(gamma(alpha(E_i) - beta(F_j) + delta_ij)) * (psi(F_j) + delta_ij) (paper, eq. 11)."""
    index, positions = neighbours
    near = gather(features, index)
    delta = _two_layers(x[:, :, None] - positions, w["xi_in"], w["xi_out"])
    inside = _linear(e, w["alpha"])[:, :, None] - _linear(near, w["beta"]) + delta
    logits = scale * _two_layers(inside, w["gamma_in"], w["gamma_out"])
    return jnp.sum(jax.nn.softmax(logits, axis=2) * (_linear(near, w["psi"]) + delta), axis=2)


def _offsets(e: Array, w: Weights) -> Float[Array, "batch query 3"]:
    return _two_layers(e, w["hidden"], w["offset"])


def plain_hand(
    params: Params, e: Float[Array, "batch query c"], config: Config
) -> Float[Array, "batch query 3"]:
    """Return the query points of the hand whose pose and shape the last embeddings tell, about the root."""
    w, (batch, query, c) = _weights(params)["regressor"], e.shape
    by_name = config.decoder.layer is Design.PAPER
    channels = e.transpose(0, 2, 1) if by_name else e.reshape(batch, c, query)
    numbers = _linear(_linear(channels, w["pool"])[..., 0], w["regress"])
    sixd, shape = numbers[:, : 6 * NUM_SKELETON_JOINTS], numbers[:, 6 * NUM_SKELETON_JOINTS :]
    rotations = rotation_from_6d(sixd.reshape(batch, NUM_SKELETON_JOINTS, 6))
    mesh = root_relative_mesh(_hand(params), HandParameters(rotations, shape))
    return join_queries(*mesh, config.decoder.query_order)


# Layers and weights.


def _linear(x: Array, w: Weights) -> Array:
    y = x @ w["kernel"]
    return y + w["bias"] if "bias" in w else y


def _two_layers(x: Array, first: Weights, second: Weights) -> Array:
    return _linear(jax.nn.relu(_linear(x, first)), second)


def _layer_norm(x: Array, w: Weights, epsilon: float) -> Array:
    mean, variance = jnp.mean(x, -1, keepdims=True), jnp.var(x, -1, keepdims=True)
    return (x - mean) / jnp.sqrt(variance + epsilon) * w["scale"] + w["bias"]


def _weights(params: Params) -> Weights:
    """Return what is trained and the running statistics in one tree."""
    return _joined(params["trainable"], params["statistics"])


def _joined(a: Weights, b: Weights) -> Weights:
    both = {key: _joined(a[key], b[key]) for key in a.keys() & b.keys()}
    return {**a, **b, **both}


def _rows(w: Weights) -> list[Weights]:
    """Return the entries of a list, whose keys are "0", "1", ..."""
    return [w[str(i)] for i in range(len(w))]


def _unstacked(w: Weights) -> list[Weights]:
    """Return the weights of each of the blocks that `w` holds along a leading axis."""
    count = len(jax.tree.leaves(w)[0])
    return [jax.tree.map(lambda leaf, i=i: leaf[i], w) for i in range(count)]


def _hand(params: Params) -> HandModel:
    return HandModel(**{name: jnp.asarray(value) for name, value in params["constants"]["hand"].items()})


def _by_view(x: Array, images: Array) -> Array:
    return x.reshape(*images.shape[:2], *x.shape[1:])
