"""Which stage of a POEM v2 model does the work: its errors with a part replaced by the truth, or by nothing.

The first stage looks at every view alone (`Poem.look`), the second joins the views (`Poem.find_hands`).
Between the two, feature maps, key points and root can be replaced, and nothing else. A second stage that
reads the images does worse without its features on the very same captures; one that is dead does not notice.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from poem_jax.data.batching import collate
from poem_jax.evaluation.protocols import MM_PER_METRE
from poem_jax.geometry.cameras import Cameras
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT, split_queries
from poem_jax.models.config import Config, ModelConfig
from poem_jax.models.hand_output import first_queries
from poem_jax.models.heat_maps import root_point, triangulate_joints
from poem_jax.models.layers import NormMode
from poem_jax.models.network import assemble, number_type
from poem_jax.models.poem_v2 import ViewFeatures
from poem_jax.models.world_frame import Reconstruction, enter_working_frame, leave_working_frame
from poem_jax.synthetic.dataset import SyntheticSample
from poem_jax.typing import Array, Float, Num, Params

DEFAULT_BATCH_SIZE = 8


@runtime_checkable
class RenderedCaptures(Protocol):
    """Captures that know which joints each view shows: `SyntheticDataset`, or anything like it."""

    def render_sample(self, index: int, num_views: int | None = None) -> SyntheticSample:
        """Return a sample without batch axis, the first `num_views` of its views."""
        ...


class StageErrors(NamedTuple):
    """Mean vertex error of every capture in mm, unless said otherwise."""

    posed: Float[np.ndarray, " sample"]
    """Of the template posed by the triangulated joints: the first stage alone. NaN for a model that finds the
    root alone."""
    layers: Float[np.ndarray, "sample layer"]
    """After every layer; the last is the model's answer."""
    zero: Float[np.ndarray, " sample"]
    """With feature maps of zeros."""
    another: Float[np.ndarray, " sample"]
    """With the feature maps of another capture of the batch."""
    true_root: Float[np.ndarray, " sample"]
    """With the true root."""
    true_joints: Float[np.ndarray, " sample"]
    """With the true key points in place of the heat maps' expectations."""
    keypoint_share: Float[np.ndarray, " sample"]
    """Error of the key points in the images over the hand's extent there."""
    hidden_share: Float[np.ndarray, " sample"]
    """Part of the key points' error that comes from joints which their view does not show."""

    @property
    def own(self) -> Float[np.ndarray, " sample"]:
        """Return the error of the model as it is."""
        return self.layers[:, -1]


class PairedDifference(NamedTuple):
    """How much worse one way is than another on the same captures."""

    mean_mm: float
    standard_error_mm: float
    """Of the mean: the spread of the differences over the captures, by the root of their number."""


def stage_errors(
    params: Params,
    config: ModelConfig,
    captures: RenderedCaptures,
    *,
    samples: int,
    num_views: int,
    batch_size: int = DEFAULT_BATCH_SIZE,
) -> StageErrors:
    """Reconstruct captures 0, 1, ... once as they are, and once with each part replaced.

    Args:
        params: as `apply` takes them.
        config: as `apply` takes it.
        captures: where the samples come from; their first `num_views` views are used.
        samples: how many; a multiple of `batch_size`.
        num_views: at least 2, so that the first stage finds the root.
        batch_size: captures at a time, at least 2; one gets the feature maps of the one before it.

    Raises:
        ValueError: a model that is not of POEM v2, counts other than these, or captures with masked views.
    """
    config = check_has_stages(config)
    if batch_size < 2 or samples < 1 or samples % batch_size:
        raise ValueError(
            "`samples` must be a multiple of `batch_size`, and that at least 2, for features are exchanged "
            f"within a batch; got {samples} and {batch_size}"
        )
    if num_views < 2:
        raise ValueError(f"`num_views` must be at least 2: one view does not fix the root; got {num_views}")
    parts: list[StageErrors] = []
    for start in range(0, samples, batch_size):
        numbers = range(start, start + batch_size)
        parts.append(
            _errors_of_batch(params, config, [captures.render_sample(n, num_views) for n in numbers])
        )
    return StageErrors(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def check_has_stages(config: ModelConfig) -> Config:
    """Return a config of POEM v2; raise `ValueError` for another system's."""
    if not isinstance(config, Config):
        raise ValueError(
            f"stages can be told apart in POEM v2's models only; got a {type(config).__name__}. Evaluate it "
            "without `--stages`"
        )
    return config


def paired_difference(
    errors: Float[np.ndarray, " sample"], reference: Float[np.ndarray, " sample"]
) -> PairedDifference:
    """Return how much larger `errors` are than `reference`, which is of the same captures, at least two."""
    difference = errors - reference
    spread = np.std(difference, ddof=1)
    return PairedDifference(float(difference.mean()), float(spread / np.sqrt(len(difference))))


def format_stages(by_views: dict[int, StageErrors]) -> str:
    """Write the means as a table, one row per view count (one at least), with its legend; no final line
    break."""
    samples, num_layers = next(iter(by_views.values())).layers.shape
    layers = [f"layer {number + 1}" for number in range(num_layers)]
    titles = ["views", "posed", *layers, "zero", "another", "true root", "true joints", "2D %", "hidden %"]
    rows = []
    for views, errors in by_views.items():
        lengths = [errors.posed.mean(), *errors.layers.mean(0), errors.zero.mean(), errors.another.mean()]
        lengths += [errors.true_root.mean(), errors.true_joints.mean()]
        shares = [100 * errors.keypoint_share.mean(), 100 * errors.hidden_share.mean()]
        cells = ["-" if np.isnan(number) else f"{number:.2f}" for number in lengths]
        rows.append([str(views), *cells, f"{shares[0]:.1f}", f"{shares[1]:.0f}"])
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    title = "  ".join(cell.rjust(width) for cell, width in zip(titles, widths, strict=True))
    return "\n".join(
        [
            f"Which stage does the work (MPVPE of {samples} captures, mm)",
            title,
            "-" * len(title),
            *lines,
            _LEGEND,
        ]
    )


_LEGEND = """posed        the template posed by the triangulated joints: the first stage alone
layer n      after each layer of the second stage; the last is the model's answer (of a parametric model,
             the mesh of its parameters)
zero         with feature maps of zeros in the second stage, which never occur in training
another      with the feature maps of another capture
true root    with the true root joint
true joints  with the true key points in every view
2D %         error of the key points over the hand's extent in the image
hidden %     part of that error that comes from joints which the view does not show"""


def _errors_of_batch(params: Params, config: Config, rendered: list[SyntheticSample]) -> StageErrors:
    batch = collate([sample.batch for sample in rendered], rendered[0].batch.views.shape[0])
    shown = np.stack([sample.joint_visible for sample in rendered])
    if not np.asarray(batch.cameras.view_mask).all():
        raise ValueError("`captures` must show all of their views; some are masked")
    assert batch.vertices_world is not None
    assert batch.joints_world is not None
    assert batch.keypoints_px is not None
    seen = _look(params, batch.views, config=config)
    num_joints = seen.keypoints_px.shape[-2]
    joints = slice(None) if num_joints == NUM_JOINTS else slice(ROOT_JOINT, ROOT_JOINT + 1)
    truth_px, shown = np.asarray(batch.keypoints_px)[..., joints, :], shown[..., joints]
    root, unknown = batch.joints_world[:, ROOT_JOINT], np.full((len(rendered), 3), np.nan, np.float32)
    nothing = _with_maps(seen, jnp.zeros_like)
    others = _with_maps(seen, functools.partial(jnp.roll, shift=1, axis=0))

    def layers(given: ViewFeatures, root_world: Array) -> Float[np.ndarray, "sample layer"]:
        found = _find(params, given, batch.views, batch.cameras, root_world, config=config)
        return _errors_mm(found, batch.vertices_world)

    extent = np.ptp(np.asarray(batch.keypoints_px), axis=-2).max(-1)[..., None]
    share = np.linalg.norm(np.asarray(seen.keypoints_px) - truth_px, axis=-1) / extent
    return StageErrors(
        posed=_posed_mm(params, config, seen, batch.views, batch.cameras, batch.vertices_world),
        layers=layers(seen, unknown),
        zero=layers(nothing, unknown)[:, -1],
        another=layers(others, unknown)[:, -1],
        true_root=layers(seen, root)[:, -1],
        true_joints=layers(seen._replace(keypoints_px=jnp.asarray(truth_px)), unknown)[:, -1],
        keypoint_share=share.mean((1, 2)),
        hidden_share=np.where(shown, 0, share).sum((1, 2)) / np.maximum(share.sum((1, 2)), 1e-9),
    )


def _with_maps(seen: ViewFeatures, change: Callable[[Array], Array]) -> ViewFeatures:
    """Change what the second stage reads; the first stage's heat maps and key points stay."""
    return seen._replace(
        feature_maps=change(seen.feature_maps),
        evidence=None if seen.evidence is None else change(seen.evidence),
    )


def _posed_mm(
    params: Params, config: Config, seen: ViewFeatures, views: Array, cams: Cameras, truth: Array
) -> Float[np.ndarray, " sample"]:
    if seen.keypoints_px.shape[-2] != NUM_JOINTS:
        return np.full(len(truth), np.nan)
    posed = _pose(params, seen, views, cams, config=config)
    return _errors_mm(posed[:, None], truth)[:, 0]


@functools.partial(jax.jit, static_argnames="config")
def _look(params: Params, views: Num[Array, "batch view h w 3"], *, config: Config) -> ViewFeatures:
    return assemble(config, params).look(views, NormMode())


@functools.partial(jax.jit, static_argnames="config")
def _find(
    params: Params,
    seen: ViewFeatures,
    views: Array,
    cams: Cameras,
    root_world: Float[Array, "batch 3"],
    *,
    config: Config,
) -> Float[Array, "batch layer vert 3"]:
    frame = enter_working_frame(views, cams, root_world, number_type(params))
    found = assemble(config, params).find_hands(seen, frame, NormMode())
    return split_queries(found.layers_world, config.decoder.query_order)[0]


@functools.partial(jax.jit, static_argnames="config")
def _pose(
    params: Params, seen: ViewFeatures, views: Array, cams: Cameras, *, config: Config
) -> Float[Array, "batch vert 3"]:
    """Return the template posed by the joints that the views' key points triangulate to, world frame; where
    they cannot be, it stands as a model that starts at the posed template starts."""
    model = assemble(config, params)
    frame = enter_working_frame(views, cams, None, number_type(params))
    joints, solved = triangulate_joints(config.root, seen.keypoints_px, seen.heat_maps, frame.cams)
    root, valid = root_point(joints, solved, frame.known_root, frame.cams.view_mask)
    hand, order = model.hand.model(), config.decoder.query_order
    posed = first_queries(
        hand,
        model.template_queries[...],  # pyright: ignore[reportAttributeAccessIssue]
        joints - root[:, None],
        jnp.all(solved, -1),
        config.basis.radius,
        order,
    )
    layers = (posed + root[:, None])[:, None]
    found = Reconstruction(seen.keypoints_px, seen.heat_maps, joints, root, valid, layers, None)
    return leave_working_frame(found, frame, hand, order).vertices_world


def _errors_mm(
    vertices: Float[Array, "sample layer vert 3"], truth: Float[Array, "sample vert 3"]
) -> Float[np.ndarray, "sample layer"]:
    apart = np.asarray(vertices, float) - np.asarray(truth, float)[:, None]
    return MM_PER_METRE * np.linalg.norm(apart, axis=-1).mean(-1)
