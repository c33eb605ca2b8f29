"""MvP, the Multi-view Pose Transformer (Wang et al. 2021), for one hand: the baseline of the paper's section
"Main experiments", which regresses joints and the parameters of a hand model.

Data flow: image -> ResNet -> maps of the three coarsest strides -> all views' mean features side by side ->
queries of the 21 joints, and where they start -> layers of [self-attention, projective attention into every
view, the views side by side, feed-forward network], after each of which every joint moves and all joints
together give pose and shape of the hand -> [joints, mesh] of every layer.

Mean features and what is read of the views stand side by side before a linear layer, in MvP and in the
release. So the model takes `num_views` views, neither more nor fewer. What a masked view holds does not
matter: the valid views of a sample fill the first places in their order, whichever they are, and the other
places hold zeros. Another order of the valid views gives another result.

The paper says no more than that MvP regresses MANO's parameters; `Design.PAPER` is MvP's own article, with
this house's choices where it is silent, `Design.RELEASE` is the authors' code. They differ in:

  part                   paper                                 release
  queries                table; its place codes plus the       sigmoid of the table; the global vector
                         global vector (query adaptation)      moves where the joints start, nothing else
  rays (RayConv)         from the camera's centre through a    through pixel index x stride, and turned by
                         cell's centre, in the common frame    the inverse rotation
  where joints are read  at projection / image size; nothing   at projection x W / (W - 1) of the map / the
                         is read behind a camera               largest such number of the whole batch
  offsets and weights    from query + rayed feature; each      from query + plain feature; (level, head) in
                         level's and head's are its own        memory is read as (head, level)
  hand parameters        linear layer                          layer norm over the 28 numbers after it
  mesh                   metres, the wrist at joint 0          shares of the cuboid, the wrist at joint 0,
                                                               stretched to metres with it

Where both say nothing of the paper's form, decided here: trunk, number of layers, heads and points, dropout
and the order within a layer are the release's, the cuboid is that of the paper's ablation of one stage;
nothing is read behind a camera; the hand's numbers come from the embeddings of all 21 joints by two layers,
anew after every decoder layer, and are small at first; its wrist stands at the regressed joint 0, and the
other joints, too, stay as they were regressed; the 15 numbers of the fingers are directions of the hand's
anatomy (`finger_directions`), with MANO's file as with the shipped hand: MANO's own components come with
imported weights alone.

So a sample of the released model sees its batch through that largest number (over valid views), and its
hand parameters describe no hand in metres: they are not part of its prediction.

Coordinates are shares of a cuboid in the primary camera's frame, in [0, 1]. Pose has 3 numbers for the wrist
(axis-angle) and 15 components of a basis for the fingers.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, normalised_from_pixels, project
from poem_jax.geometry.sampling import sample_levels
from poem_jax.geometry.transforms import (
    matmul,
    rotate_points,
    rotation_from_axis_angle,
    transpose,
    unit_vectors,
)
from poem_jax.hand.joint_limits import anatomical_axes
from poem_jax.hand.model import HandMesh, HandModel, hand_mesh
from poem_jax.hand.topology import (
    NUM_FINGERS,
    NUM_JOINTS,
    NUM_SHAPES,
    NUM_SKELETON_JOINTS,
    WRIST,
    join_queries,
)
from poem_jax.models.backbones import ResNet
from poem_jax.models.config import Design
from poem_jax.models.decoder import PAPER_EPSILON, MultiHeadAttention, OffsetNetwork
from poem_jax.models.deformable_attention import sample_deformed
from poem_jax.models.frustum import denormalised, sigmoid_step
from poem_jax.models.hand_output import HandParameters
from poem_jax.models.layers import (
    ConvNorm,
    DecoderRow,
    Exact,
    NormMode,
    PerQuery,
    dropout,
    layer_norm,
    linear,
    normal,
    trunk_images,
    uniform,
)
from poem_jax.models.mvp_config import NUM_LEVELS, MvpConfig, MvpDecoderConfig
from poem_jax.models.network import Constant, HandConstants
from poem_jax.models.point_features import valid_views_first
from poem_jax.models.world_frame import Reconstruction, WorkingFrame, leave_working_frame
from poem_jax.typing import Array, Bool, Float, Num, PRNGKeyArray

NUM_POSE_COMPONENTS = 15
"""Numbers that bend the fingers."""
_SPLIT_HAND = np.cumsum([3, NUM_POSE_COMPONENTS])
_HAND_NUMBERS = 3 + NUM_POSE_COMPONENTS + NUM_SHAPES
_SMALL = 1e-2
"""Scale of the paper form's first hand weights: training starts near the flat mean hand."""
_GRID_LIMIT = 1.1
"""The release reads its plain features no farther out than this, of a map that spans [-1, 1]."""


class ViewLevels(NamedTuple):
    """What is computed of every view alone; leading axes (image,) or (batch, view)."""

    levels: tuple[Float[Array, "..."], ...]
    """Feature maps (*batch, h, w, c), coarsest first."""


class Mvp(DecoderRow):
    """MvP for one hand, its layers made for `config.num_views` views."""

    def __init__(self, config: MvpConfig, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.config, form = config, _FORMS[config.design]
        self.trunk = ResNet(config.backbone, rngs=rngs)
        self.reduce = nnx.List(
            ConvNorm(c, config.width, 3, bias=True, rngs=rngs)
            for c in config.backbone.channels[::-1][:NUM_LEVELS]
        )
        self.queries = form.queries(config, rngs=rngs)
        self.layers = nnx.List(MvpLayer(config, rngs=rngs) for _ in range(config.decoder.num_layers))
        self.hand = HandConstants(hand)
        self.pose_components = Constant(jnp.asarray(finger_directions(hand)))

    def look(
        self, views: Num[Array, "*batch h w 3"], mode: NormMode, settled: NormMode | None = None
    ) -> ViewLevels:
        """Do what is done with every view alone: the trunk's three coarsest maps, at one width."""
        images = trunk_images(views, self.config, self.pose_components[...].dtype)
        maps = self.trunk(images, mode if settled is None else settled)
        levels = (reduce(x, mode) for reduce, x in zip(self.reduce, maps[::-1], strict=False))
        return ViewLevels(tuple(x.reshape(*views.shape[:-3], *x.shape[1:]) for x in levels))

    def find_hands(
        self,
        seen: ViewLevels,
        frame: WorkingFrame,
        mode: NormMode,
        *,
        dropout_key: PRNGKeyArray | None = None,
    ) -> Prediction:
        """Join what was seen in the views (batch, view) to one hand per sample, in the user's world.

        A sample is valid if any of its views is. `mode` is not used: nothing here has a batch norm.
        """
        scene = view_scene(self.config, seen, frame.cams)
        mean_features = jnp.stack([jnp.mean(x, (2, 3)) for x in scene.levels], 2)
        x, places, shares = self.queries(mean_features.reshape(len(mean_features), -1))
        joints, numbers = [], []
        for i, layer in enumerate(self.layers):
            drop = None if dropout_key is None else jax.random.fold_in(dropout_key, i)
            x, shares, hand_numbers = self.run(layer, x, places, shares, scene, drop)
            joints.append(shares)
            numbers.append(hand_numbers)
        shares, numbers = jnp.stack(joints, 1), jnp.stack(numbers, 1)
        return self._in_world(shares, numbers, frame)

    def _in_world(
        self,
        shares: Float[Array, "batch layer 21 3"],
        numbers: Float[Array, "batch layer number"],
        frame: WorkingFrame,
    ) -> Prediction:
        """Build every layer's hand, and leave the working frame."""
        config, hand, form = self.config, self.hand.model(), _FORMS[self.config.design]
        turn, bend, shape = jnp.split(numbers, _SPLIT_HAND, -1)
        pose = jnp.concatenate([turn, matmul(bend, self.pose_components[...])], -1)
        pose = pose.reshape(*pose.shape[:-1], NUM_SKELETON_JOINTS, 3)
        mesh = form.place(hand_mesh(hand, pose, shape, center_joint=WRIST), shares, config)
        found = Reconstruction(
            keypoints_px=None,
            heat_maps=None,
            reference_joints=None,
            root=None,
            valid=jnp.any(frame.cams.view_mask, -1),
            layers=join_queries(mesh.vertices, mesh.joints, config.query_order),
            parameters=HandParameters(rotation_from_axis_angle(pose[:, -1]), shape[:, -1])
            if form.is_metric
            else None,
        )
        return leave_working_frame(found, frame, hand, config.query_order)


class Scene(NamedTuple):
    """The views of a batch, valid ones first."""

    levels: tuple[Float[Array, "..."], ...]
    """Feature maps (batch, view, h, w, c), coarsest first; zero in masked views."""
    rays: tuple[Float[Array, "..."], ...]
    """Unit vectors (batch, view, h, w, 3) of the levels' cells."""
    cams: Cameras


def view_scene(config: MvpConfig, seen: ViewLevels, cams: Cameras) -> Scene:
    """Put the valid views of every sample first, and zeros where there are none."""
    form, levels = _FORMS[config.design], []
    first = cams
    for level in seen.levels:
        level, first = valid_views_first(level, cams)
        levels.append(jnp.where(first.view_mask[..., None, None, None], level, 0))
    rays = tuple(form.rays(first, x.shape[-3:-1], config.image_hw) for x in levels)
    return Scene(tuple(levels), rays, first)


# Rays.


def paper_rays(
    cams: Cameras, map_hw: tuple[int, int], image_hw: tuple[int, int]
) -> Float[Array, "batch view h w 3"]:
    """Return the direction of the ray through every cell's centre, in the world of `cams`."""
    R_world_from_cam = transpose(cams.T_cam_from_world[..., :3, :3])
    return _turned_rays(cams.K, R_world_from_cam, map_hw, image_hw, cell_offset=0.5)


def release_rays(
    cams: Cameras, map_hw: tuple[int, int], image_hw: tuple[int, int]
) -> Float[Array, "batch view h w 3"]:
    """Return the same through the corner of a cell that is nearest pixel (0, 0), turned the wrong way."""
    return _turned_rays(cams.K, cams.T_cam_from_world[..., :3, :3], map_hw, image_hw, cell_offset=0.0)


def _turned_rays(
    K: Float[Array, "batch view 3 3"],
    turn: Float[Array, "batch view 3 3"],
    map_hw: tuple[int, int],
    image_hw: tuple[int, int],
    *,
    cell_offset: float,
) -> Float[Array, "batch view h w 3"]:
    v, u = (
        (jnp.arange(cells, dtype=K.dtype) + cell_offset) * (pixels / cells)
        for cells, pixels in zip(map_hw, image_hw, strict=True)
    )
    uv_px = jnp.stack(jnp.meshgrid(u, v), -1).reshape(-1, 2)
    xy = normalised_from_pixels(K, uv_px)
    rays = unit_vectors(rotate_points(turn, jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], -1)))
    return rays.reshape(*rays.shape[:-2], *map_hw, 3)


# Where the joints are read.


class Places(NamedTuple):
    """Where the maps of every view are read for a joint."""

    uv_share: Float[Array, "batch view joint level 2"]
    """Shares (u / W, v / H) of a level's map."""
    is_seen: Bool[Array, "batch view joint"]
    """What is read elsewhere is zero."""


def paper_places(config: MvpConfig, shares: Float[Array, "batch joint 3"], scene: Scene) -> Places:
    """Return the joints' projections over the image's size; nothing is read behind a camera."""
    uv_px, depth = project(
        scene.cams.K, scene.cams.T_cam_from_world, denormalised(shares, config.cuboid)[:, None]
    )
    uv_share = uv_px / jnp.array(config.image_hw[::-1], uv_px.dtype)
    by_level = jnp.broadcast_to(uv_share[..., None, :], (*uv_share.shape[:-1], NUM_LEVELS, 2))
    return Places(by_level, scene.cams.view_mask[..., None] & (depth > 0))


def release_places(config: MvpConfig, shares: Float[Array, "batch joint 3"], scene: Scene) -> Places:
    """Return the projections, in pixels, times W / (W - 1) and H / (H - 1) of the levels, over the largest of
    these numbers in the valid views of the whole batch."""
    uv_px, _ = project(
        scene.cams.K, scene.cams.T_cam_from_world, denormalised(shares, config.cuboid)[:, None]
    )
    sizes = np.array([x.shape[-3:-1][::-1] for x in scene.levels])
    enlarged = uv_px[..., None, :] * jnp.asarray(sizes / (sizes - 1), uv_px.dtype)
    valid = scene.cams.view_mask[..., None]
    largest = jnp.max(jnp.where(valid[..., None, None], enlarged, -jnp.inf))
    # Without any valid view there is no largest number.
    return Places(enlarged / jnp.where(jnp.any(valid), largest, 1), jnp.broadcast_to(valid, uv_px.shape[:-1]))


# Queries.


class _JointQueries(nnx.Module):
    """A table of embeddings and place codes, a global vector of all views, and where the joints start."""

    def __init__(self, config: MvpConfig, *, rngs: nnx.Rngs) -> None:
        width = config.width
        self.table = PerQuery(normal(rngs.params(), (NUM_JOINTS, 2 * width)))
        self.mix = linear(config.num_views * NUM_LEVELS * width, width, rngs=rngs)
        self.locate = linear(width, 3, exact=True, rngs=rngs)

    def _batch(self, x: Float[Array, "joint c"], size: int) -> Float[Array, "batch joint c"]:
        return jnp.broadcast_to(x, (size, *x.shape))


class PaperQueries(_JointQueries):
    """Query adaptation: the global vector is part of the place codes (Wang et al. 2021, section 3.2)."""

    def __call__(
        self, mean_features: Float[Array, "batch c"]
    ) -> tuple[Float[Array, "batch joint c2"], Float[Array, "batch joint c2"], Float[Array, "batch joint 3"]]:
        """Return first embeddings, place codes, and where the joints start, as shares of the cuboid.

        Args:
            mean_features: means of the maps, (view, level, channel) in memory.
        """
        embeddings, codes = jnp.split(self.table[...], 2, -1)
        codes = codes + self.mix(mean_features)[:, None]
        return self._batch(embeddings, len(codes)), codes, jax.nn.sigmoid(self.locate(codes))


class ReleaseQueries(_JointQueries):
    """The global vector moves where the joints start; the table is squashed."""

    def __init__(self, config: MvpConfig, *, rngs: nnx.Rngs) -> None:
        super().__init__(config, rngs=rngs)
        self.locate.kernel = Exact(uniform(rngs.params(), (config.width, 3)))

    def __call__(
        self, mean_features: Float[Array, "batch c"]
    ) -> tuple[Float[Array, "batch joint c2"], Float[Array, "batch joint c2"], Float[Array, "batch joint 3"]]:
        """As `PaperQueries`."""
        embeddings, codes = jnp.split(jax.nn.sigmoid(self.table[...]), 2, -1)
        moved = codes + self.mix(mean_features)[:, None]
        embeddings, codes = (self._batch(x, len(moved)) for x in (embeddings, codes))
        return embeddings, codes, jax.nn.sigmoid(self.locate(moved))


# Projective attention.


class _ProjectiveAttention(nnx.Module):
    """Every joint reads a few points of every view's maps about its projection (Wang et al. 2021, eq. 3).

    A view's maps with the directions of their rays beside them are mixed first (RayConv). Offsets and weights
    come from the query and the feature at the projection, each level alone.
    """

    def __init__(self, config: MvpDecoderConfig, width: int, *, rngs: nnx.Rngs) -> None:
        self.num_heads, self.num_points = config.num_heads, config.num_points
        samples = config.num_heads * config.num_points
        self.ray_mix = linear(width + 3, width, rngs=rngs)
        self.offsets = linear(width, 2 * samples, exact=True, zero=True, rngs=rngs)
        self.offsets.bias = Exact(_first_offsets(config.num_heads, config.num_points))
        self.weights = linear(width, samples, exact=True, rngs=rngs)
        self.out = linear(width, width, rngs=rngs)

    def __call__(
        self, queries: Float[Array, "batch joint c"], places: Places, scene: Scene
    ) -> Float[Array, "batch view joint c"]:
        """Return what every joint reads in every view; zero where it is not seen."""
        values = self._values(scene)
        at_place = self._at_place(scene.levels, values, places.uv_share) + queries[:, None, :, None]
        offsets = self._by_head(self.offsets(at_place), 2)
        logits = self._by_head(self.weights(at_place), 1)
        weights = jax.nn.softmax(logits.reshape(*logits.shape[:-3], -1), -1).reshape(logits.shape[:-1])
        cells_wh = np.array([x.shape[-3:-1][::-1] for x in values])[:, None]
        locations = places.uv_share[..., None, :, None, :] + offsets / jnp.asarray(cells_wh, offsets.dtype)
        read = self.out(sample_deformed(values, locations, weights))
        return jnp.where(places.is_seen[..., None], read, 0)

    def _values(self, scene: Scene) -> tuple[Array, ...]:
        """Mix every cell's feature and ray."""
        both = zip(scene.levels, scene.rays, strict=True)
        return tuple(self.ray_mix(jnp.concatenate([x, rays], -1)) for x, rays in both)

    def _at_place(
        self,
        levels: tuple[Array, ...],
        values: tuple[Array, ...],
        uv_share: Float[Array, "batch view joint level 2"],
    ) -> Float[Array, "batch view joint level c"]:
        """Return the features at the projections."""
        raise NotImplementedError

    def _by_head(
        self, numbers: Float[Array, "batch view joint level number"], size: int
    ) -> Float[Array, "batch view joint head level point size"]:
        """Tell what the numbers belong to."""
        raise NotImplementedError


class PaperProjectiveAttention(_ProjectiveAttention):
    """Offsets and weights come from the maps that know their rays, a head's from its own numbers."""

    def _at_place(self, levels: tuple[Array, ...], values: tuple[Array, ...], uv_share: Array) -> Array:
        return _sampled(values, uv_share)

    def _by_head(self, numbers: Array, size: int) -> Array:
        split = numbers.reshape(*numbers.shape[:-1], self.num_heads, self.num_points, size)
        return jnp.swapaxes(split, -3, -4)


class ReleaseProjectiveAttention(_ProjectiveAttention):
    """Offsets and weights come from the plain maps, near their borders at the farthest; (level, head, point)
    in memory is read as (head, level, point), so that heads and levels are mixed."""

    def _at_place(self, levels: tuple[Array, ...], values: tuple[Array, ...], uv_share: Array) -> Array:
        grid = jnp.clip(2 * uv_share - 1, -_GRID_LIMIT, _GRID_LIMIT)
        return _sampled(levels, (grid + 1) / 2)

    def _by_head(self, numbers: Array, size: int) -> Array:
        return numbers.reshape(*numbers.shape[:-2], self.num_heads, NUM_LEVELS, self.num_points, size)


def _sampled(
    maps: tuple[Array, ...], uv_share: Float[Array, "batch view joint level 2"]
) -> Float[Array, "batch view joint level c"]:
    """Read every level where it is told."""
    return jnp.swapaxes(sample_levels(maps, jnp.swapaxes(uv_share, -2, -3)), -2, -3)


def _first_offsets(num_heads: int, num_points: int) -> Float[Array, " number"]:
    """Let every head look its own way, point by point farther, in cells (Zhu et al. 2021, appendix A.4)."""
    angle = 2 * np.pi * np.arange(num_heads) / num_heads
    way = np.stack([np.cos(angle), np.sin(angle)], -1)
    way /= np.abs(way).max(-1, keepdims=True)
    offsets = way[:, None] * np.arange(1, num_points + 1)[:, None]
    return jnp.asarray(offsets.reshape(-1), jnp.float32)


# The hand.


class PaperHand(nnx.Module):
    """Two layers from all joints' embeddings to the numbers of the hand."""

    def __init__(self, config: MvpConfig, *, rngs: nnx.Rngs) -> None:
        self.dropout_rate = config.decoder.dropout
        self.hidden = linear(NUM_JOINTS * config.width, config.width, rngs=rngs)
        self.out = linear(config.width, _HAND_NUMBERS, exact=True, rngs=rngs)
        self.out.kernel = Exact(_SMALL * self.out.kernel[...])

    def __call__(
        self, embeddings: Float[Array, "batch joint c"], dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "batch number"]:
        """Return wrist rotation (axis-angle), components of the fingers' pose, and shape coefficients."""
        hidden = jax.nn.relu(self.hidden(embeddings.reshape(len(embeddings), -1)))
        return self.out(dropout(hidden, self.dropout_rate, dropout_key))


class ReleaseHand(nnx.Module):
    """The same through a layer norm, so that no number can be large unless others are small."""

    def __init__(self, config: MvpConfig, *, rngs: nnx.Rngs) -> None:
        self.regress = PaperHand(config, rngs=rngs)
        self.norm = layer_norm(_HAND_NUMBERS, PAPER_EPSILON, rngs=rngs)

    def __call__(
        self, embeddings: Float[Array, "batch joint c"], dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "batch number"]:
        """As `PaperHand`."""
        return self.norm(self.regress(embeddings, dropout_key))


def paper_mesh(mesh: HandMesh, shares: Float[Array, "*batch 21 3"], config: MvpConfig) -> HandMesh:
    """Place a hand about its wrist, metres, at the first of the joints, which stay as they were regressed."""
    joints = denormalised(shares, config.cuboid)
    return HandMesh(mesh.vertices + joints[..., WRIST, None, :], joints)


def release_mesh(mesh: HandMesh, shares: Float[Array, "*batch 21 3"], config: MvpConfig) -> HandMesh:
    """Take the hand's metres for shares of the cuboid: it is then stretched with it."""
    vertices = denormalised(mesh.vertices + shares[..., WRIST, None, :], config.cuboid)
    return HandMesh(vertices, denormalised(shares, config.cuboid))


def finger_directions(hand: HandModel) -> Float[np.ndarray, "15 45"]:
    """Return an orthonormal basis of finger poses of any hand, for models that are trained anew.

    Each finger has three directions in the space of its joints' axis-angle vectors (45 numbers, MANO's
    order): its first joint bends, its first joint spreads, and its other two joints bend together. MANO's own
    are the first 15 principal components of scanned poses, which released weights bring along.
    """
    flexion, abduction, _ = np.moveaxis(anatomical_axes(hand), 1, 0)
    basis = np.zeros((NUM_FINGERS, 3, NUM_FINGERS, 3, 3))
    for finger in range(NUM_FINGERS):
        first, rest = 3 * finger, slice(3 * finger + 1, 3 * finger + 3)
        basis[finger, 0, finger, 0] = flexion[first]
        basis[finger, 1, finger, 0] = abduction[first]
        basis[finger, 2, finger, 1:] = flexion[rest] / np.sqrt(2)
    return basis.reshape(NUM_POSE_COMPONENTS, -1).astype(np.float32)


# A layer.


class MvpLayer(nnx.Module):
    """Joints read each other, then every view; a layer norm after each sum; then they move."""

    def __init__(self, config: MvpConfig, *, rngs: nnx.Rngs) -> None:
        self.config, width, decoder = config, config.width, config.decoder
        form = _FORMS[config.design]
        self.self_attention = MultiHeadAttention(
            width, decoder.num_heads, dropout_rate=decoder.dropout, rngs=rngs
        )
        self.projective_attention = form.attention(decoder, width, rngs=rngs)
        self.fuse = linear(config.num_views * width, width, rngs=rngs)
        self.hidden = linear(width, decoder.ffn_expansion * width, rngs=rngs)
        self.out = linear(decoder.ffn_expansion * width, width, rngs=rngs)
        self.norms = nnx.List(layer_norm(width, PAPER_EPSILON, rngs=rngs) for _ in range(3))
        self.branch = OffsetNetwork(width, width, rngs=rngs)
        self.hand = form.hand(config, rngs=rngs)

    def __call__(
        self,
        embeddings: Float[Array, "batch joint c"],
        codes: Float[Array, "batch joint c"],
        shares: Float[Array, "batch joint 3"],
        scene: Scene,
        dropout_key: PRNGKeyArray | None = None,
    ) -> tuple[Float[Array, "batch joint c"], Float[Array, "batch joint 3"], Float[Array, "batch number"]]:
        """Return the updated embeddings, the moved joints (shares of the cuboid) and the hand's numbers.

        Where the joints are read teaches them nothing: the projections let no gradient through.
        """
        after_self, after_views, after_network = self.norms
        rate = self.config.decoder.dropout
        drop = [None] * 5 if dropout_key is None else list(jax.random.split(dropout_key, 5))
        places = _FORMS[self.config.design].places(self.config, jax.lax.stop_gradient(shares), scene)

        x = embeddings
        x = after_self(x + self.self_attention(x + codes, x + codes, drop[0], values=x))
        read = jnp.swapaxes(self.projective_attention(x + codes, places, scene), 1, 2)
        fused = self.fuse(read.reshape(*x.shape[:2], -1))
        x = after_views(x + dropout(fused, rate, drop[1]))
        hidden = dropout(jax.nn.relu(self.hidden(x)), rate, drop[2])
        x = after_network(x + dropout(self.out(hidden), rate, drop[3]))
        return x, sigmoid_step(shares, self.branch(x)), self.hand(x, drop[4])


class _Form(NamedTuple):
    """The parts in which paper and release differ."""

    queries: Callable[..., Any]
    rays: Callable[[Cameras, tuple[int, int], tuple[int, int]], Array]
    places: Callable[[MvpConfig, Array, Scene], Places]
    attention: Callable[..., Any]
    hand: Callable[..., Any]
    place: Callable[[HandMesh, Array, MvpConfig], HandMesh]
    is_metric: bool
    """Whether the hand's numbers describe it in metres."""


_FORMS = {
    Design.PAPER: _Form(
        PaperQueries, paper_rays, paper_places, PaperProjectiveAttention, PaperHand, paper_mesh, True
    ),
    Design.RELEASE: _Form(
        ReleaseQueries,
        release_rays,
        release_places,
        ReleaseProjectiveAttention,
        ReleaseHand,
        release_mesh,
        False,
    ),
}
