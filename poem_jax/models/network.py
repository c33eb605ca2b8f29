"""The POEM v2 network as one module, and its parameters as a plain pytree.

The way through the network is one: enter the working frame, `Poem.look` at every view, `Poem.find_hands` in
what was seen, leave the working frame. `forward` does it at once; `infer.py` looks view by view.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, primary_view
from poem_jax.geometry.neighbours import farthest_points
from poem_jax.hand.model import HandModel
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import join_queries
from poem_jax.models.aggregation import ProjectiveAggregation
from poem_jax.models.backbones import HRNet, ResNet
from poem_jax.models.config import Config, DecoderOutput, Design, FirstQueries, HRNetConfig
from poem_jax.models.decoder import Decoder, JointDecoder, Surroundings
from poem_jax.models.hand_output import (
    ParameterRegressor,
    draw_in,
    first_queries,
    root_relative_mesh,
    template_queries,
)
from poem_jax.models.heat_maps import HeatMapBranch, root_point, triangulate_joints
from poem_jax.models.layers import NormMode
from poem_jax.models.point_features import (
    FeatureBranch,
    basis_points,
    evidence,
    projected_features,
    sine_code,
    valid_views_first,
)
from poem_jax.models.vector_attention import Neighbours
from poem_jax.models.world_frame import (
    Reconstruction,
    WorkingFrame,
    enter_working_frame,
    leave_working_frame,
)
from poem_jax.typing import Array, Float, Num, Params, PRNGKeyArray

_MAX_SHOWN = 3
"""Mismatches that an error lists."""


class Constant(nnx.Variable):
    """An array that is stored with the weights and never trained."""


class StaticArray(np.ndarray):
    """Indices or flags among the constants: an array to all who read it, but no leaf of a pytree, so that
    nothing differentiates, casts or traces it."""


jax.tree_util.register_pytree_node(
    StaticArray, lambda array: ((), _ByValue(array)), lambda by_value, _: by_value.array
)


class _ByValue:
    """What `jit` compares to know a static array again."""

    def __init__(self, array: StaticArray) -> None:
        self.array, self.key = array, (array.dtype.str, array.shape, array.tobytes())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByValue) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


GROUPS = {"trainable": nnx.Param, "statistics": nnx.BatchStat, "constants": Constant}
"""Which kind of variable each part of `params` holds."""


class ViewFeatures(NamedTuple):
    """What is computed of every view alone; leading axes (image,) or (batch, view)."""

    keypoints_px: Float[Array, "*batch joint 2"]
    heat_maps: Float[Array, "*batch joint h w"]
    feature_maps: Float[Array, "*batch h w c"]
    """Without the release's position code, which depends on the other views."""
    evidence: Float[Array, "*batch joint h w"] | None
    """Of `heat_maps`, for the joint decoder (`point_features.evidence`); None without one."""


class HandConstants(nnx.Module):
    """The hand model's arrays, stored with the weights."""

    def __init__(self, hand: HandModel) -> None:
        for name, value in hand._asdict().items():
            setattr(self, name, Constant(np.asarray(value)))

    def model(self) -> HandModel:
        """Return them as a `HandModel`."""
        return HandModel(*(getattr(self, name)[...] for name in HandModel._fields))


class AnchorConstants(nnx.Module):
    """The rows that every query reads in the first layer, and their positions in basis radii.

    They spread over the template: each is the point farthest from those before it, from point 0 on.
    """

    def __init__(self, config: Config, template: Float[np.ndarray, "799 3"]) -> None:
        index = farthest_points(template, config.decoder.num_neighbours)
        self.index = Constant(index)
        self.positions = Constant(np.asarray(template[index] / config.basis.radius, np.float32))

    def surroundings(self) -> Surroundings:
        """Let all queries of all samples (batch 1) read these rows, of queries and basis alike."""
        index, positions = (jnp.asarray(leaf[...])[:, None, None] for leaf in (self.index, self.positions))
        near = Neighbours(index, positions)
        return Surroundings(near, near)


class Poem(nnx.Module):
    """POEM v2 (paper, figure "Model architecture")."""

    def __init__(self, config: Config, hand: HandModel, *, rngs: nnx.Rngs) -> None:
        self.config = config
        trunk = config.backbone
        self.trunk = (HRNet if isinstance(trunk, HRNetConfig) else ResNet)(trunk, rngs=rngs)  # pyright: ignore[reportArgumentType]
        self.heat_maps = HeatMapBranch(config.root, trunk, rngs=rngs)
        self.features = FeatureBranch(config, rngs=rngs)
        self.aggregation = ProjectiveAggregation(config.aggregation, config.width, rngs=rngs)
        self.joint_decoder = (
            None
            if config.joint_decoder is None
            else JointDecoder(config.joint_decoder, config.width, config.basis.radius, rngs=rngs)
        )
        self.decoder = Decoder(config.decoder, config.width, rngs=rngs)
        parametric = config.decoder.output is DecoderOutput.HAND_PARAMETERS
        is_release = config.decoder.layer is Design.RELEASE
        self.regressor = (
            ParameterRegressor(config.width, row_major=is_release, rngs=rngs) if parametric else None
        )
        self.basis_points = Constant(jnp.asarray(basis_points(config.basis)))
        template = template_queries(hand, config.decoder.query_order)
        self.template_queries = Constant(jnp.asarray(template))
        self.anchors = AnchorConstants(config, template) if is_release else None
        self.hand = HandConstants(hand)

    def look(self, views: Num[Array, "*batch h w 3"], mode: NormMode) -> ViewFeatures:
        """Do what is done with every view alone: trunk, heat maps and feature map; any leading axes."""
        levels = self.trunk(self._normalised(views.reshape(-1, *views.shape[-3:])), mode)
        keypoints_px, heat_maps = self.heat_maps(levels, mode)
        said = None if self.joint_decoder is None else jnp.moveaxis(evidence(heat_maps), -1, -3)
        seen = ViewFeatures(keypoints_px, heat_maps, self.features(levels, heat_maps, mode), said)
        return jax.tree.map(lambda leaf: leaf.reshape(*views.shape[:-3], *leaf.shape[1:]), seen)

    def find_hands(
        self,
        seen: ViewFeatures,
        frame: WorkingFrame,
        mode: NormMode,
        first: Surroundings | None = None,
        dropout_key: PRNGKeyArray | None = None,
    ) -> Prediction:
        """Join what was seen in the views (batch, view) to one hand per sample, in the user's world.

        `first`: whom the first decoder layer reads, if it was prepared.
        """
        cams, config, radius = frame.cams, self.config, self.config.basis.radius
        reference_joints, solved = triangulate_joints(config.root, seen.keypoints_px, seen.heat_maps, cams)
        # In training the first stage learns from its own loss alone: rays that nearly coincide would send
        # wild gradients through the triangulation.
        joints = jax.lax.stop_gradient(reference_joints) if mode.training else reference_joints
        root, valid = root_point(joints, solved, frame.known_root, cams.view_mask)

        all_solved, about_root = jnp.all(solved, -1), joints - root[:, None]
        moved_joints = self._move_joints(about_root, root, seen, cams, mode)
        joint_layers = [self._start(at, all_solved) for at in moved_joints]
        start = joint_layers[-1] if joint_layers else self._start(about_root, all_solved)
        basis_features = self._read_views(seen.feature_maps, cams, root)
        first = self.first_surroundings() if first is None else first
        moved, embeddings = self.decoder(
            start / radius, self.basis_points[...] / radius, basis_features, first, dropout_key
        )

        hand, parameters = self.hand.model(), None
        layers = [*joint_layers, *(radius * queries for queries in moved)]
        if self.regressor is not None:
            parameters = self.regressor(embeddings)
            layers.append(join_queries(*root_relative_mesh(hand, parameters), config.decoder.query_order))
        found = Reconstruction(
            seen.keypoints_px,
            seen.heat_maps,
            reference_joints,
            root,
            valid,
            jnp.stack(layers, 1) + root[:, None, None],
            parameters,
        )
        return leave_working_frame(found, frame, hand, config.decoder.query_order)

    def first_surroundings(self) -> Surroundings | None:
        """Return whom the first decoder layer reads (batch 1), None where that depends on the sample."""
        return None if self.anchors is None else self.anchors.surroundings()

    def prepared_surroundings(self) -> Surroundings | None:
        """Return the same with all that is constant in it computed."""
        first = self.first_surroundings()
        if first is None or self.config.decoder.first_queries is not FirstQueries.TEMPLATE:
            return first
        start = self.template_queries[...] / self.config.basis.radius
        return self.decoder.layers[0].with_deltas(start[None], first)  # pyright: ignore[reportAttributeAccessIssue]

    def _normalised(self, views: Num[Array, "image h w 3"]) -> Float[Array, "image h w 3"]:
        scale = 255.0 if views.dtype == jnp.uint8 else 1.0
        images = jnp.asarray(views, self.basis_points[...].dtype) / scale
        return (images - self.config.image_mean) / self.config.image_std

    def _read_views(
        self, feature_maps: Float[Array, "batch view h w c"], cams: Cameras, root: Float[Array, "batch 3"]
    ) -> Float[Array, "batch basis c"]:
        """Return the features of the basis points about `root`, fused over the views."""
        by_paper = self.config.features.design is Design.PAPER
        feature_maps = self.features.with_position(feature_maps, cams.view_mask)
        if self.config.aggregation.design is Design.RELEASE:
            feature_maps, cams = valid_views_first(feature_maps, cams)
        basis = root[:, None] + self.basis_points[...]
        sampled, uv_share = projected_features(
            feature_maps, cams, basis, self.config.image_hw, zeros_behind=by_paper
        )
        if by_paper:
            sampled = sampled + sine_code(uv_share, sampled.shape[-1])
        return self.aggregation(sampled, cams.view_mask, primary_view(cams.view_mask))

    def _move_joints(
        self, joints: Array, root: Array, seen: ViewFeatures, cams: Cameras, mode: NormMode
    ) -> list[Float[Array, "batch 21 3"]]:
        """Return the joints after every layer of the joint decoder; they, and `joints`, about the root.

        Joints that went astray are drawn in beforehand, as they are before they pose the template.
        """
        if self.joint_decoder is None:
            return []
        assert seen.evidence is not None
        start = draw_in(joints, self.config.basis.radius) + root[:, None]
        moved = self.joint_decoder(
            start, seen.evidence, seen.feature_maps, cams, self.config.image_hw, training=mode.training
        )
        return [at - root[:, None] for at in moved]

    def _start(self, joints: Array, solved: Array) -> Float[Array, "batch query 3"]:
        """Return the query points before the first layer, metres about the root."""
        template, order = self.template_queries[...], self.config.decoder.query_order
        if self.config.decoder.first_queries is FirstQueries.TEMPLATE:
            return jnp.broadcast_to(template, (joints.shape[0], *template.shape))
        return first_queries(self.hand.model(), template, joints, solved, self.config.basis.radius, order)


def forward(
    params: Params,
    views: Num[Array, "batch view h w 3"],
    cams: Cameras,
    *,
    config: Config,
    root_world: Float[Array, "batch 3"] | None = None,
    train: bool = False,
    frozen_views: bool = False,
    key: PRNGKeyArray | None = None,
    axis_name: str | None = None,
) -> tuple[Prediction, dict]:
    """Do what `apply` does without its checks, and return the batch-norm statistics too.

    Args:
        params: from `init` or `load`.
        views: as in `apply`.
        cams: as in `apply`.
        config: the configuration that `params` were made with.
        root_world: as in `apply`, in training the noisy true root; NaN rows are triangulated.
        train: normalise by the moments of this batch's valid views and move the running statistics.
        frozen_views: in training, do with every view alone what is done at inference, and let no gradient
            into it.
        key: in training, what dropout draws from; None = nothing is dropped.
        axis_name: device axis over which the moments are averaged.

    Returns: the prediction, and the new `params["statistics"]` (unchanged unless `train`).
    """
    frame = enter_working_frame(views, cams, root_world, number_type(params))
    model = assemble(config, params)
    mode = NormMode(frame.cams.view_mask.reshape(-1) if train else None, axis_name)
    prediction = reconstruct(model, views, frame, mode, key if train else None, frozen_views=frozen_views)
    return prediction, statistics(model) if train else params["statistics"]


def reconstruct(
    model: Poem,
    views: Num[Array, "batch view h w 3"],
    frame: WorkingFrame,
    mode: NormMode,
    dropout_key: PRNGKeyArray | None = None,
    *,
    frozen_views: bool = False,
) -> Prediction:
    """Reconstruct one hand per sample in the user's world, from within the working frame; `frozen_views` as
    in `forward`."""
    shown = jnp.where(frame.cams.view_mask[..., None, None, None], views, 0)
    seen = model.look(shown, NormMode() if frozen_views else mode)
    seen = jax.lax.stop_gradient(seen) if frozen_views else seen
    return model.find_hands(seen, frame, mode, dropout_key=dropout_key)


def number_type(params: Params) -> Any:
    """Return the number type in which a model computes."""
    return params["constants"]["basis_points"].dtype


class _Blueprint(NamedTuple):
    graph: Any
    states: dict[str, dict[tuple, Any]]


def build(config: Config, rngs: nnx.Rngs) -> Poem:
    """Make a model with fresh weights and the shipped hand."""
    return Poem(config, default_hand(), rngs=rngs)


def split(model: Poem) -> Params:
    """Return the model's arrays."""
    params = {group: _nested(nnx.to_flat_state(nnx.state(model, kind))) for group, kind in GROUPS.items()}
    return with_static_indices(params)


def with_static_indices(params: Params) -> Params:
    """Make indices and flags among the constants static, so that `jax.grad` works on `params`."""

    def static(leaf: Array) -> Array:
        return leaf if jnp.issubdtype(leaf.dtype, jnp.floating) else np.asarray(leaf).view(StaticArray)

    return {**params, "constants": jax.tree.map(static, params["constants"])}


def leaves_with_names(tree: Any) -> dict[str, Array]:
    """List the arrays of a pytree by dotted path, static ones too."""
    leaves = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda leaf: isinstance(leaf, StaticArray))
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def statistics(model: Poem) -> dict[str, Any]:
    """Return the batch-norm statistics alone, as in `params["statistics"]`."""
    return _nested(nnx.to_flat_state(nnx.state(model, nnx.BatchStat)))


def assemble(config: Config, params: Params) -> Poem:
    """Return the model that holds the arrays of `params`."""
    blueprint = _blueprint(config)
    states = [
        nnx.from_flat_state(
            (path, variable.replace(_at(params[group], path))) for path, variable in flat.items()
        )
        for group, flat in blueprint.states.items()
    ]
    return nnx.merge(blueprint.graph, *states)


def describe(config: Config) -> Params:
    """Return the shapes and dtypes that `init` would give, without computing anything."""
    states = _blueprint(config).states
    return {group: _nested(flat.items()) for group, flat in states.items()}


def check_params(config: Config, params: Params) -> None:
    """Raise `ValueError` unless `params` has the paths and shapes of `config`."""
    expected, got = _shapes(describe(config)), _shapes(params)
    if expected == got:
        return
    names = sorted(name for name in expected.keys() | got.keys() if expected.get(name) != got.get(name))
    lines = [f"{name}: expected {expected.get(name)}, got {got.get(name)}" for name in names[:_MAX_SHOWN]]
    raise ValueError(
        f"`params` do not belong to `config`: {len(names)} entries differ, the first are {'; '.join(lines)}. "
        "Pass the config that the parameters were made or loaded with."
    )


class _SameKey(nnx.Rngs):
    """For weights of which only the shapes are wanted: under a trace Flax takes seconds to count keys."""

    def __init__(self, key: Array) -> None:
        super().__init__(0)
        self._key = key

    def params(self) -> Array:
        """Return the key."""
        return self._key


@functools.lru_cache(maxsize=32)
def _blueprint(config: Config) -> _Blueprint:
    abstract = nnx.eval_shape(lambda key: build(config, _SameKey(key)), jax.random.key(0))
    graph, *states = nnx.split(abstract, *GROUPS.values())
    return _Blueprint(graph, {g: dict(nnx.to_flat_state(s)) for g, s in zip(GROUPS, states, strict=True)})


def _nested(flat: Any) -> dict[str, Any]:
    """Nest (path, variable) pairs; list positions become string keys, which every file format keeps."""
    tree: dict[str, Any] = {}
    for path, variable in flat:
        node = tree
        for part in path[:-1]:
            node = node.setdefault(str(part), {})
        node[str(path[-1])] = variable.get_value()
    return tree


def _at(tree: dict[str, Any], path: tuple) -> Array:
    for part in path:
        tree = tree[str(part)]
    return jnp.asarray(tree)


def _shapes(params: Params) -> dict[str, tuple[int, ...]]:
    return {name: np.shape(leaf) for name, leaf in leaves_with_names(params).items()}
