"""`apply` and `infer` compute what the plain form does with geometry written anew in NumPy.

The oracle shares no projection, triangulation, sampling or change of frame with the package
(`numpy_geometry.py`), and its learned parts are those of `benchmarks/plain_form.py`. What it shares: the hand
model and its posing by joints, tested in `tests/hand` and `test_hand_output.py`.
"""

import functools
import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest

from poem_jax.geometry.neighbours import farthest_points
from poem_jax.hand.model import template_queries
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_QUERIES, ROOT_JOINT
from poem_jax.models import apply, infer, layers
from poem_jax.models.config import DecoderOutput, Design, ViewWeights
from poem_jax.models.presets import TINY, V2_MEDIUM_RELEASE, preset
from tests.models import numpy_geometry
from tests.precision import convolve_by_products

FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "plain_form.py"
VIEWS = 3
LARGEST_M = 1e-7
"""Farthest that a query point may be from the oracle's, float64."""


@pytest.fixture(scope="module")
def plain_form():
    spec = importlib.util.spec_from_file_location("plain_form", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _complete(params: dict, config) -> dict:
    """Give the weights of a release-like model the constants that go with its choices."""
    template = template_queries(default_hand(), config.decoder.query_order)
    extra = {"template_queries": template}
    if config.decoder.layer is Design.RELEASE:
        index = farthest_points(template, config.decoder.num_neighbours)
        extra["anchors"] = {"index": index, "positions": template[index] / config.basis.radius}
    return {**params, "constants": {**params["constants"], **extra}}


_GAINS = {"second": 0.1, "expand": 0.1, "fuse": 0.1, "theta_out": 0.2, "offset": 0.1}


def _damped(params: dict) -> dict:
    """Keep all numbers near 1 and every move within centimetres, as training does.

    Random residual branches, exchanges and similarities (cubes of the features) would let numbers grow until
    no softmax has more than one weight, and rounding errors with them.
    """

    def damp(path, leaf):
        *names, kind = (part.key for part in path)
        if kind == "bias":
            return np.float32(0.2) * leaf
        last = "scale" if "norm" in names else "kernel"
        gain = min((_GAINS.get(name, 1.0) for name in names), default=1.0)
        return np.float32(gain) * leaf if kind == last else leaf

    return {**params, "trainable": jax.tree_util.tree_map_with_path(damp, params["trainable"])}


def _like_release(micro, output=DecoderOutput.OFFSETS):
    """All choices of the release at the size of `micro`, with as many basis points as its anchors need."""
    made = V2_MEDIUM_RELEASE
    return replace(
        made,
        image_hw=micro.image_hw,
        width=micro.width,
        backbone=replace(micro.backbone, blocks=(1, 1, 1), channels=(8, 8, 16)),
        features=replace(made.features, stride=8),
        basis=replace(made.basis, num_points=NUM_QUERIES),
        decoder=replace(made.decoder, num_layers=2, num_neighbours=4, ffn_expansion=1, output=output),
    )


def _like_tiny(micro):
    """All choices of `tiny` at the size of `micro`."""
    decoder = replace(TINY.decoder, num_neighbours=4, ffn_expansion=1)
    return replace(
        micro, root=TINY.root, features=TINY.features, aggregation=TINY.aggregation, decoder=decoder
    )


class Oracle(NamedTuple):
    """What the network should give; world, metres, as `Prediction` has it."""

    layers: np.ndarray
    keypoints_px: np.ndarray
    heat_maps: np.ndarray


@pytest.fixture(scope="module")
def oracle(plain_form):
    """The learned parts of the plain form, with the geometry between them in NumPy."""

    def run(config, params, images, cams, root_world) -> Oracle:
        part = {name: _plain(plain_form, name, config) for name in LEARNED}
        keypoints_px, heat_maps, maps = map(np.asarray, part["views"](params, images))
        maps = np.asarray(part["map_position"](params, maps))
        samples = zip(keypoints_px, heat_maps, maps, cams.K, cams.T_cam_from_world, root_world, strict=True)
        scenes = [_scene(config, params, *sample) for sample in samples]
        joints, solved, root, sampled, share = (np.stack(leaves) for leaves in zip(*scenes, strict=True))
        tokens = part["aggregation"](params, sampled, share)
        start = part["start"](params, joints - root[:, None], solved)
        moved, embeddings, _ = part["decoder"](params, start, tokens)
        layers = [config.basis.radius * np.asarray(queries) for queries in moved]
        if config.decoder.output is DecoderOutput.HAND_PARAMETERS:
            layers.append(np.asarray(part["hand"](params, embeddings)))
        to_world = [np.linalg.inv(T[0]) for T in cams.T_cam_from_world]
        in_world = [
            [numpy_geometry.move(T, layer[i] + root[i]) for layer in layers] for i, T in enumerate(to_world)
        ]
        return Oracle(np.array(in_world), keypoints_px, heat_maps)

    return run


LEARNED = ("views", "map_position", "aggregation", "start", "decoder", "hand")


def _scene(config, params, keypoints_px, heat_maps, maps, K, T_cam_from_world, root_world) -> tuple:
    """One sample's geometry in the first camera's frame: joints, which are solved, root, samples, shares."""
    T = np.array([t @ np.linalg.inv(T_cam_from_world[0]) for t in T_cam_from_world])
    weights = None
    if config.root.view_weights is ViewWeights.HEAT_SPREAD:
        spreads = np.array([[numpy_geometry.spread(heat) for heat in view] for view in heat_maps])
        weights = 1 / np.maximum(spreads, numpy_geometry.SHARPEST_MAP)
    joints, solved = numpy_geometry.lift_all(
        keypoints_px, K, T, weights, unit_rows=config.root.design is Design.PAPER
    )
    index = ROOT_JOINT if len(joints) > 1 else 0
    root = joints[index] if solved[index] else numpy_geometry.FALLBACK_ROOT
    if np.isfinite(root_world).all():
        root = numpy_geometry.move(T_cam_from_world[0], root_world)
    points = root + params["constants"]["basis_points"]
    zeros_behind = config.features.design is Design.PAPER
    samples = numpy_geometry.sample_views(maps, K, T, points, config.image_hw, zeros_behind=zeros_behind)
    return joints, solved, root, *samples


@pytest.fixture
def compare(oracle, make_params, make_scene):
    """Return the largest distances (metres) of `apply` and `infer` from the oracle.

    All in float64: neighbours are then the same but for exact ties, so that nothing need be told of them.
    """

    def compare(config, views=VIEWS, seed=0, root=(0.01, 0.01, 0.01)) -> list[float]:
        with jax.enable_x64(True):
            params = _float64(_complete(_damped(make_params(config)), config))
            images, cams = make_scene(1, views, seed, config.image_hw)
            cams, root = _float64(cams), np.array([root])
            expected = oracle(config, params, images, cams, root)
            assert np.isfinite(expected.layers).all()
            apart = []
            for result in (
                apply.apply(params, images, cams, config=config, root_world=root),
                infer.infer(infer.prepare(params, config), images, cams, root_world=root),
            ):
                np.testing.assert_allclose(result.keypoints_px, expected.keypoints_px, atol=1e-7)
                np.testing.assert_allclose(result.heat_maps, expected.heat_maps, atol=1e-10)
                apart.append(np.linalg.norm(result.layers_world - expected.layers, axis=-1).max())
        print(f"{[f'{distance:.1e}' for distance in apart]} m")
        return apart

    return compare


def _float64(tree):
    arrays = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda a: a.astype(np.float64) if a.dtype.kind == "f" else a, arrays)


def _plain(plain_form, part, config):
    """A part of the plain form, compiled without optimisation, which is quicker."""
    return jax.jit(
        functools.partial(getattr(plain_form, f"plain_{part}"), config=config),
        compiler_options={"xla_backend_optimization_level": 0},
    )


def test_paper(compare, micro_config):
    assert max(compare(micro_config)) < LARGEST_M


@pytest.mark.slow
def test_paper_hrnet(compare, hrnet_config):
    assert max(compare(hrnet_config)) < LARGEST_M


@pytest.mark.slow
def test_paper_parametric(compare, parametric_config):
    assert max(compare(parametric_config)) < LARGEST_M


@pytest.mark.slow
def test_release(compare, micro_config):
    assert max(compare(_like_release(micro_config))) < LARGEST_M


@pytest.mark.slow
def test_release_parametric_of_one_view(compare, micro_config):
    config = _like_release(micro_config, DecoderOutput.HAND_PARAMETERS)
    assert max(compare(config, views=1)) < LARGEST_M


@pytest.mark.slow
def test_tiny(compare, micro_config):
    """Its queries start at triangulated joints, which also give the root."""
    unknown = (np.nan, np.nan, np.nan)
    assert max(compare(_like_tiny(micro_config))) < LARGEST_M
    assert max(compare(_like_tiny(micro_config), root=unknown)) < LARGEST_M


def test_joint_decoder(plain_form, joints_config, make_params, make_scene):
    """Against the plain form's own layers, by the package's geometry, in float64."""
    with jax.enable_x64(True):
        params = _float64(_damped(make_params(joints_config)))
        images, cams = make_scene(1, VIEWS)
        cams = _float64(cams)
        expected, _ = _plain(plain_form, "forward", joints_config)(params, images, cams)
        found = apply.apply(params, images, cams, config=joints_config)
        apart = np.linalg.norm(found.layers_world - expected.layers, axis=-1)
        moved = np.linalg.norm(found.joints_world - found.reference_joints_world, axis=-1)
    assert moved.max() > 1e-4
    assert apart.max() < LARGEST_M


@pytest.mark.parity
@pytest.mark.parametrize("like", [lambda micro: micro, _like_release], ids=["paper", "release"])
def test_float32_is_off_by_rounding(plain_form, micro_config, make_params, make_scene, like):
    """Against the plain form's own geometry; a rounding may choose other neighbours for single queries."""
    config = like(micro_config)
    params = _complete(_damped(make_params(config)), config)
    images, cams = make_scene(1, VIEWS, 0, config.image_hw)
    root = np.full((1, 3), 0.01, np.float32)
    expected, _ = _plain(plain_form, "forward", config)(params, images, cams, root=root)
    for result in (
        apply.apply(params, images, cams, config=config, root_world=root),
        infer.infer(infer.prepare(params, config), images, cams, root_world=root),
    ):
        apart = np.linalg.norm(result.layers_world - expected.layers, axis=-1)
        assert np.mean(apart < 1e-5) > 0.995
        assert np.median(apart) < 2e-6


def test_neighbours_may_be_given(plain_form, micro_config, make_params, make_scene):
    params, (images, cams) = make_params(micro_config), make_scene(2, VIEWS)
    run = _plain(plain_form, "forward", micro_config)
    expected, found = run(params, images, cams)
    again, used = run(params, images, cams, neighbours=found)
    np.testing.assert_array_equal(found, used)
    np.testing.assert_allclose(again.layers, expected.layers, atol=1e-6)
    others, _ = run(params, images, cams, neighbours=[63 - index for index in found])
    assert np.abs(others.layers - expected.layers).max() > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["v2-base", "v2-medium-release", "v2-medium-mano-release"])
def test_full_size(compare, name, monkeypatch):
    """Convolutions by matrix products, which XLA:CPU computes several times as fast in float64."""
    monkeypatch.setattr(layers, "convolve", convolve_by_products)
    assert max(compare(preset(name), views=2)) < LARGEST_M
