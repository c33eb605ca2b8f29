"""Training losses of multi-view hand reconstruction, and the recipes that weigh them.

All points are metres, all pixels belong to the crops as fed, and D is the diagonal of a crop in pixels.
Every mean runs over what exists: padded views (`view_mask`), padded samples (`sample_mask`) and samples that
could not be solved (`Prediction.valid`) change neither a loss nor a gradient. The terms of the first stage,
key points and triangulated joints, do not ask whether the second was solved; joints that could not be
triangulated (`Prediction.reference_joints_mask`) are left out.
"""

from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from poem_jax.batch import MultiViewBatch, Prediction
from poem_jax.geometry.cameras import Cameras, anchor_to_primary, fill_masked_views, project
from poem_jax.geometry.transforms import (
    axis_angle_from_rotation,
    matmul,
    quaternion_from_rotation,
    rotate_points,
    rotation_from_axis_angle,
)
from poem_jax.hand.model import HandModel, joints_from_vertices
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT, QueryOrder, split_queries
from poem_jax.typing import Array, Bool, Float


class Penalty(Enum):
    """How a coordinate's residual is punished."""

    SQUARED = "squared"
    ABSOLUTE = "absolute"


class Layers(Enum):
    """Which layers of `Prediction.layers_world` are supervised; the terms of several layers are summed."""

    LAST = "last"
    EVERY = "every"


class PoseSpace(Enum):
    """The space in which two poses are subtracted."""

    AXIS_ANGLE = "axis_angle"
    ROTATION = "rotation"


@dataclass(frozen=True)
class LossRecipe:
    """Weights and forms of the terms of `multi_view_losses`; the defaults are POEM v2's release's."""

    name: str
    layers: Layers = Layers.LAST
    keypoints: float = 10.0
    """Heat-map coordinates against the projected joints, in diagonals."""
    keypoint_penalty: Penalty = Penalty.SQUARED
    heat_maps: float = 0.0
    """Cross-entropy of the heat maps and a Gaussian about the true key point; neither paper nor release has
    it. It tells every cell what to do, where the coordinates' loss tells only their mean."""
    heat_map_sigma: float = 0.75
    """Spread of that Gaussian, in cells."""
    triangulation: float = 0.0
    """The triangulated joints of the first stage, squared errors in square metres."""
    joints: float = 1.0
    regressed_joints: float = 1.0
    """Joints regressed from the vertices."""
    joint_penalty: Penalty = Penalty.SQUARED
    vertices: float = 1.0
    """Always an L1 loss."""
    reprojection: float = 1.0
    """Projected joints, in diagonals, clamped to `reprojection_limit`."""
    vertex_reprojection: float = 0.0
    """Projected vertices in the same form, against the projected true ones."""
    reprojection_limit: float = 0.5
    """Diagonals. A coordinate of a projected point that is farther off counts as this far, without
    gradient."""
    reprojection_penalty: Penalty = Penalty.SQUARED
    pose: float = 0.001
    pose_space: PoseSpace = PoseSpace.AXIS_ANGLE
    shape: float = 0.0005
    point_unit_m: float = 1.0
    """The length that counts as 1 in the three point terms."""


RELEASE = LossRecipe("release")
"""The released training code: the last layer only."""

PAPER = LossRecipe("paper", layers=Layers.EVERY, pose_space=PoseSpace.ROTATION)
"""The release's weights on every layer, summed; poses are compared as rotations, since axis-angle wraps."""

SYNTHETIC = LossRecipe(
    "synthetic",
    layers=Layers.EVERY,
    keypoints=10.0,
    keypoint_penalty=Penalty.ABSOLUTE,
    heat_maps=1.0,
    joint_penalty=Penalty.ABSOLUTE,
    reprojection=0.0,
    point_unit_m=0.1,
)
"""For short runs: absolute errors, points in units of 10 cm; the 2D term does not fade as it shrinks."""

V1 = LossRecipe("v1", layers=Layers.EVERY, triangulation=10.0, pose=0.0, shape=0.0)
"""POEM v1 as released: heat-map coordinates and triangulated joints, and every layer, summed. As in all
recipes made from it below, pose and shape are not supervised, though MvP's mesh is made of them."""

V1_ONE_STAGE = replace(V1, name="v1-1stage", keypoints=0.0, triangulation=0.0)
"""Its ablation without a first stage."""

MESH_TRANSFORMER = replace(V1_ONE_STAGE, name="meshtr", reprojection_limit=1.0)
"""PE-MeshTR and FTL-MeshTR as released."""

MVP = replace(MESH_TRANSFORMER, name="mvp", vertex_reprojection=1.0)
"""MvP as released."""

RECIPES = {
    recipe.name: recipe for recipe in (RELEASE, PAPER, SYNTHETIC, V1, V1_ONE_STAGE, MESH_TRANSFORMER, MVP)
}


_HEAT_FLOOR = 1e-8
"""Added to the heat before its logarithm."""


class _Points(NamedTuple):
    """What the model says about one decoder layer, in the world frame."""

    joints: Float[Array, "batch 21 3"]
    vertices: Float[Array, "batch 778 3"]


class Share(NamedTuple):
    """Which share of a batch is at hand. Means over it are shares, too: their sum is the whole batch's mean.

    Of a batch that is split over devices the sum runs over `axis_name`, and the shares know how many entries
    all of them have. Of one that is taken part by part they know what exists in all parts, not what will be
    solved: a part that cannot solve a sample takes the mean of its others.
    """

    axis_name: str | None = None
    """Mapped axis over which the batch is split."""
    views: Float[Array, ""] | None = None
    """How many of the batch's existing views are in this part, 0 to 1; None = the batch is taken at once."""
    samples: Float[Array, ""] | None = None
    """The same of its samples."""

    def over_views(self, values: Float[Array, "..."], mask: Bool[Array, "batch view"]) -> Float[Array, ""]:
        """Return this share of the mean over the views that count."""
        mean = masked_mean(values, mask, axis_name=self.axis_name)
        return mean if self.views is None else self.views * mean

    def over_samples(
        self, values: Float[Array, "..."], mask: Bool[Array, "batch *#rest"]
    ) -> Float[Array, ""]:
        """Return this share of the mean over the samples, or their points, that count."""
        mean = masked_mean(values, mask, axis_name=self.axis_name)
        return mean if self.samples is None else self.samples * mean


WHOLE = Share()


def masked_mean(
    values: Float[Array, "..."], mask: Bool[Array, "..."], *, axis_name: str | None = None
) -> Float[Array, ""]:
    """Average the entries whose mask is True.

    Args:
        values: any numbers; masked entries may hold anything, NaN included.
        mask: shape of the leading axes of `values`; True = counts.
        axis_name: mapped axis over which the batch is split. The result is then this shard's share of the
            global mean: `jax.lax.psum` of the shares is that mean, however many entries each shard has.

    Returns:
        The mean, or 0 where nothing is valid.
    """
    full_mask = jnp.broadcast_to(mask.reshape(mask.shape + (1,) * (values.ndim - mask.ndim)), values.shape)
    count = full_mask.sum(dtype=values.dtype)
    if axis_name is not None:
        count = jax.lax.psum(count, axis_name)
    return jnp.where(full_mask, values, 0.0).sum() / jnp.maximum(count, 1.0)


def multi_view_losses(
    prediction: Prediction,
    batch: MultiViewBatch,
    *,
    hand: HandModel,
    image_hw: tuple[int, int],
    recipe: LossRecipe,
    query_order: QueryOrder = QueryOrder.VERTICES_FIRST,
    share: Share = WHOLE,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Compute the weighted training loss and its unweighted terms.

    The terms are those of the releases: `keypoints` (of a model with heat maps), `joints`,
    `regressed_joints`, `vertices`, `reprojection`, for parametric predictions `pose` and `shape`, and where
    the recipe weighs them `heat_maps`, `triangulation` and `vertex_reprojection`. L1 terms are taken in the
    primary camera's frame, so that no choice of the world frame changes the loss.

    Args:
        prediction: the model's output; `keypoints_px` holds the root joint only, or all 21.
        batch: ground truth in the same world frame; `view_mask` and `sample_mask` say what counts.
        hand: gives the regressor of the joints from the vertices.
        image_hw: height and width of the crops as fed.
        recipe: weights and forms; static.
        query_order: layout of `prediction.layers_world`.
        share: which share of a batch this is; losses and terms are then shares whose sum is the global value.

    Returns:
        The loss, and the terms by name (of the last layer; point terms in `recipe.point_unit_m`).

    Raises:
        ValueError: the recipe weighs what the prediction does not have: key points or triangulated joints.
    """
    view_mask, sample_mask = valid_masks(prediction, batch)
    diagonal = _diagonal(image_hw)
    cameras = fill_masked_views(Cameras(batch.cameras.K, batch.cameras.T_cam_from_world, view_mask))
    truth = _Points(batch.joints_world, batch.vertices_world)

    first_stage = keypoint_terms(prediction, batch, image_hw=image_hw, recipe=recipe, share=share)
    if recipe.triangulation:
        first_stage["triangulation"] = triangulation_term(prediction, batch, recipe=recipe, share=share)

    compare = partial(
        _point_terms,
        truth=truth,
        keypoints_px=batch.keypoints_px,
        cameras=cameras,
        sample_mask=sample_mask,
        hand=hand,
        diagonal=diagonal,
        recipe=recipe,
        share=share,
    )
    layer_terms = [compare(points) for points in _supervised(prediction, recipe.layers, query_order)]
    terms = {
        **first_stage,
        **layer_terms[-1],
        **_parametric_terms(prediction, batch, cameras, sample_mask, recipe.pose_space, share),
    }
    loss = weighted(first_stage, recipe)
    for term in layer_terms:
        loss += weighted(term, recipe)
    loss += weighted({name: terms[name] for name in ("pose", "shape") if name in terms}, recipe)
    return loss, terms


def keypoint_terms(
    prediction: Prediction,
    batch: MultiViewBatch,
    *,
    image_hw: tuple[int, int],
    recipe: LossRecipe,
    share: Share = WHOLE,
) -> dict[str, Float[Array, ""]]:
    """Compute the terms of the first stage in the images, `keypoints` and, where the recipe weighs it,
    `heat_maps`; none for a model without heat maps.

    Arguments, masks and errors as in `multi_view_losses`.
    """
    if recipe.keypoints:
        _present(prediction.keypoints_px, "keypoints", recipe)
    if prediction.keypoints_px is None:
        return {}
    view_mask, _ = valid_masks(prediction, batch)
    truth_px = match_keypoints(prediction.keypoints_px, batch)
    residual = (prediction.keypoints_px - truth_px) / _diagonal(image_hw)
    terms = {"keypoints": _mean_of_norms(residual, view_mask, recipe.keypoint_penalty, share)}
    if recipe.heat_maps and prediction.heat_maps is not None:
        cells = truth_px * (prediction.heat_maps.shape[-1] / image_hw[1])
        entropy = _cross_entropy(prediction.heat_maps, cells, recipe.heat_map_sigma)
        terms["heat_maps"] = share.over_views(entropy, view_mask)
    return terms


def triangulation_term(
    prediction: Prediction, batch: MultiViewBatch, *, recipe: LossRecipe, share: Share = WHOLE
) -> Float[Array, ""]:
    """Compute the mean squared error of the joints that could be triangulated, also in samples whose second
    stage does not count, since this loss is what brings those back.

    Arguments, masks and errors as in `multi_view_losses`.
    """
    joints = _present(prediction.reference_joints_world, "triangulation", recipe)
    solved = prediction.reference_joints_mask
    exists = jnp.any(valid_masks(prediction, batch)[0], -1)
    counted = exists[:, None] & (jnp.ones(NUM_JOINTS, bool) if solved is None else solved)
    return share.over_samples((joints - batch.joints_world) ** 2, counted)


def _present(value: Array | None, weight: str, recipe: LossRecipe) -> Array:
    """Return what a weight of the recipe is about, or raise where the model does not give it."""
    if value is None:
        raise ValueError(
            f"the loss recipe {recipe.name!r} weighs `{weight}` by {getattr(recipe, weight):g}, which the "
            f"model does not give; set its weight to 0, or take the recipe of the model, one of "
            f"{', '.join(RECIPES)}"
        )
    return value


def weighted(terms: dict[str, Array], recipe: LossRecipe) -> Array:
    """Sum the terms, each times the recipe's weight of its name."""
    return sum((getattr(recipe, name) * value for name, value in terms.items()), jnp.zeros(()))


def _cross_entropy(
    heat_maps: Float[Array, "*batch h w"], cells: Float[Array, "*batch 2"], sigma: float
) -> Float[Array, "*batch"]:
    """Compare maps that sum to 1 with Gaussians about `cells`; zero where those lie outside the map."""

    def profile(center: Array, size: int) -> Array:
        return jnp.exp(-0.5 * ((jnp.arange(size) + 0.5 - center[..., None]) / sigma) ** 2)

    h, w = heat_maps.shape[-2:]
    target = profile(cells[..., 1], h)[..., :, None] * profile(cells[..., 0], w)[..., None, :]
    target = target / (jnp.sum(target, (-2, -1), keepdims=True) + 1e-6)
    return -jnp.sum(target * jnp.log(heat_maps + _HEAT_FLOOR), (-2, -1))


def valid_masks(
    prediction: Prediction, batch: MultiViewBatch
) -> tuple[Bool[Array, "batch view"], Bool[Array, " batch"]]:
    """Return the views whose 2D terms count and the samples whose 3D terms count."""
    view_mask, sample_mask = existing_masks(batch)
    return view_mask, sample_mask & prediction.valid


def existing_masks(batch: MultiViewBatch) -> tuple[Bool[Array, "batch view"], Bool[Array, " batch"]]:
    """Return the views and samples that are no padding."""
    sample_mask = jnp.any(jnp.asarray(batch.cameras.view_mask), axis=-1)
    if batch.sample_mask is not None:
        sample_mask = sample_mask & batch.sample_mask
    return batch.cameras.view_mask & sample_mask[:, None], sample_mask


def match_keypoints(
    keypoints_px: Float[Array, "batch view joint 2"], batch: MultiViewBatch
) -> Float[Array, "batch view joint 2"]:
    """Return the true key points that belong to the predicted ones: the root joint, or all 21."""
    if keypoints_px.shape[-2] == 1:
        return batch.keypoints_px[..., ROOT_JOINT : ROOT_JOINT + 1, :]
    return batch.keypoints_px


def _supervised(prediction: Prediction, layers: Layers, query_order: QueryOrder) -> list[_Points]:
    """List the supervised layers, the last one last: it is the prediction itself."""
    last = _Points(prediction.joints_world, prediction.vertices_world)
    if layers is Layers.LAST:
        return [last]
    vertices, joints = split_queries(prediction.layers_world[:, :-1], query_order)
    return [_Points(joints[:, i], vertices[:, i]) for i in range(vertices.shape[1])] + [last]


def _point_terms(
    points: _Points,
    *,
    truth: _Points,
    keypoints_px: Array,
    cameras: Cameras,
    sample_mask: Array,
    hand: HandModel,
    diagonal: float,
    recipe: LossRecipe,
    share: Share,
) -> dict[str, Array]:
    """Compute the four terms of one decoder layer, or five."""
    _, T_primary_from_world = anchor_to_primary(cameras.T_cam_from_world, cameras.view_mask)
    rotation = T_primary_from_world[..., :3, :3]

    def difference(a_world: Array, b_world: Array) -> Array:
        return rotate_points(rotation, a_world - b_world) / recipe.point_unit_m

    def mean(residual: Array, penalty: Penalty) -> Array:
        return share.over_samples(_punish(residual, penalty), sample_mask)

    regressed = joints_from_vertices(hand, points.vertices)
    regressed_truth = joints_from_vertices(hand, truth.vertices)
    view_mask = cameras.view_mask & sample_mask[:, None]

    def in_images(points_world: Array, target_px: Array) -> Array:
        residual = (_projected(cameras, points_world) - target_px) / diagonal
        residual = jnp.clip(residual, -recipe.reprojection_limit, recipe.reprojection_limit)
        return _mean_of_norms(residual, view_mask, recipe.reprojection_penalty, share)

    terms = {
        "joints": mean(difference(points.joints, truth.joints), recipe.joint_penalty),
        "regressed_joints": mean(difference(regressed, regressed_truth), recipe.joint_penalty),
        "vertices": mean(difference(points.vertices, truth.vertices), Penalty.ABSOLUTE),
        "reprojection": in_images(points.joints, keypoints_px),
    }
    if recipe.vertex_reprojection:
        terms["vertex_reprojection"] = in_images(points.vertices, _projected(cameras, truth.vertices))
    return terms


def _projected(cameras: Cameras, points_world: Float[Array, "batch point 3"]) -> Array:
    return project(cameras.K, cameras.T_cam_from_world, points_world[:, None])[0]


def _parametric_terms(
    prediction: Prediction,
    batch: MultiViewBatch,
    cameras: Cameras,
    sample_mask: Array,
    space: PoseSpace,
    share: Share,
) -> dict[str, Array]:
    """Compare pose and shape where both sides have them; poses in the primary camera's frame."""
    terms = {}
    if prediction.pose is not None and batch.pose is not None:
        _, T_primary_from_world = anchor_to_primary(cameras.T_cam_from_world, cameras.view_mask)
        pose, truth = (
            _turned_rotations(T_primary_from_world, vectors) for vectors in (prediction.pose, batch.pose)
        )
        if space is PoseSpace.AXIS_ANGLE:
            root = axis_angle_from_rotation(truth[:, :1])
            pose, truth = released_axis_angle(pose), jnp.concatenate([root, batch.pose[:, 1:]], 1)
        terms["pose"] = share.over_samples((pose - truth) ** 2, sample_mask)
    if prediction.shape is not None and batch.shape is not None:
        residual = prediction.shape - batch.shape
        terms["shape"] = share.over_samples(residual**2, sample_mask)
    return terms


def released_axis_angle(rotations: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Return the axis-angle vectors that the released parametric model compares.

    They come from the quaternion whose largest component is positive, so that an angle may exceed pi: the
    rotation that `axis_angle_from_rotation` gives too, but another number in a loss.
    """
    q = quaternion_from_rotation(rotations)
    largest = jnp.take_along_axis(q, jnp.argmax(jnp.abs(q), -1)[..., None], -1)
    turned = axis_angle_from_rotation(rotations)
    # The other quaternion of the rotation: the same axis backwards, by 2 pi less the angle.
    angle = jnp.sqrt(jnp.maximum(jnp.sum(turned**2, -1, keepdims=True), 1e-12))
    return jnp.where(largest < 0, turned * (1 - 2 * jnp.pi / angle), turned)


def _turned_rotations(
    T_a_from_world: Float[Array, "batch 4 4"], pose: Float[Array, "batch 16 3"]
) -> Float[Array, "batch 16 3 3"]:
    """Return the joints' rotations, the first one into frame a."""
    rotations = rotation_from_axis_angle(jnp.asarray(pose))
    first = matmul(T_a_from_world[:, :3, :3], rotations[:, 0])
    return jnp.concatenate([first[:, None], rotations[:, 1:]], 1)


def _diagonal(image_hw: tuple[int, int]) -> float:
    return float(image_hw[0] ** 2 + image_hw[1] ** 2) ** 0.5


def _punish(residual: Array, penalty: Penalty) -> Array:
    return residual**2 if penalty is Penalty.SQUARED else jnp.abs(residual)


def _mean_of_norms(residual: Array, mask: Array, penalty: Penalty, share: Share) -> Array:
    """Average over points the penalties summed over u and v."""
    return share.over_views(_punish(residual, penalty).sum(-1), mask)
