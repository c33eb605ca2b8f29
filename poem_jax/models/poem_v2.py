"""The POEM v2 network (paper, figure "Model architecture").

`Poem.look` does what is done with every view alone, `Poem.find_hands` joins what was seen to one hand per
sample. `network.py` runs them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.batch import Prediction
from poem_jax.geometry.cameras import Cameras, primary_view
from poem_jax.geometry.neighbours import farthest_points
from poem_jax.hand.model import HandModel, template_queries
from poem_jax.hand.topology import join_queries
from poem_jax.models.aggregation import ProjectiveAggregation
from poem_jax.models.backbones import HRNet, ResNet
from poem_jax.models.config import Config, DecoderOutput, Design, FirstQueries, HRNetConfig
from poem_jax.models.decoder import Decoder, JointDecoder, Surroundings
from poem_jax.models.hand_output import ParameterRegressor, draw_in, first_queries, root_relative_mesh
from poem_jax.models.heat_maps import HeatMapBranch, root_point, triangulate_joints
from poem_jax.models.layers import NormMode, trunk_images
from poem_jax.models.network import Constant, HandConstants
from poem_jax.models.point_features import (
    FeatureBranch,
    basis_points,
    evidence,
    projected_features,
    sine_code,
    valid_views_first,
)
from poem_jax.models.vector_attention import Neighbours
from poem_jax.models.world_frame import Reconstruction, WorkingFrame, leave_working_frame
from poem_jax.typing import Array, Float, Num, PRNGKeyArray


class ViewFeatures(NamedTuple):
    """What is computed of every view alone; leading axes (image,) or (batch, view)."""

    keypoints_px: Float[Array, "*batch joint 2"]
    heat_maps: Float[Array, "*batch joint h w"]
    feature_maps: Float[Array, "*batch h w c"]
    """Without the release's position code, which depends on the other views."""
    evidence: Float[Array, "*batch joint h w"] | None
    """Of `heat_maps`, for the joint decoder (`point_features.evidence`); None without one."""


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

    def look(
        self, views: Num[Array, "*batch h w 3"], mode: NormMode, settled: NormMode | None = None
    ) -> ViewFeatures:
        """Do what is done with every view alone: trunk, heat maps and feature map; any leading axes."""
        settled = mode if settled is None else settled
        levels = self.trunk(trunk_images(views, self.config, self.basis_points[...].dtype), settled)
        keypoints_px, heat_maps = self.heat_maps(levels, settled)
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
            solved,
        )
        return leave_working_frame(found, frame, hand, config.decoder.query_order)

    def first_surroundings(self) -> Surroundings | None:
        """Return whom the first decoder layer reads (batch 1), None where that depends on the sample."""
        return None if self.anchors is None else self.anchors.surroundings()

    def prepared(self) -> dict[str, Surroundings | None]:
        """Return the same as an argument of `find_hands`, with all that is constant in it computed."""
        return {"first": self._prepared_surroundings()}

    def _prepared_surroundings(self) -> Surroundings | None:
        first = self.first_surroundings()
        if first is None or self.config.decoder.first_queries is not FirstQueries.TEMPLATE:
            return first
        start = self.template_queries[...] / self.config.basis.radius
        return self.decoder.layers[0].with_deltas(start[None], first)  # pyright: ignore[reportAttributeAccessIssue]

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
            sampled = sampled + sine_code(uv_share, sampled.shape[-1]).astype(sampled.dtype)
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
