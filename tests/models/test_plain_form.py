"""The optimised forms compute what the plain form of `benchmarks/plain_form.py` does."""

import functools
import importlib.util
import itertools
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from poem_jax.geometry.neighbours import farthest_points, gather
from poem_jax.hand.template import default_hand
from poem_jax.hand.topology import NUM_QUERIES
from poem_jax.models import inference, poem
from poem_jax.models.config import DecoderOutput, FirstNeighbours
from poem_jax.models.presets import TINY, V2_MEDIUM_RELEASE, preset
from poem_jax.models.reconstruction import template_queries
from poem_jax.models.vector_attention import Neighbours

FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "plain_form.py"
VIEWS = 3


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
    if config.decoder.first_neighbours is FirstNeighbours.ANCHORS:
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
    return replace(micro, root=TINY.root, aggregation=TINY.aggregation, decoder=decoder)


@pytest.fixture
def compare(plain_form, make_params, make_scene, monkeypatch):
    """Return the largest distances (metres) of `apply` and `infer` from the plain form."""

    def compare(config, views=VIEWS, seed=0, dtype=np.float32) -> list[float]:
        params = _complete(_damped(make_params(config)), config)
        images, cams = make_scene(1, views, seed, config.image_hw)
        root = np.full((1, 3), 0.01, np.float32)
        params, cams, root = (_cast(tree, dtype) for tree in (params, cams, root))
        expected, found = _plain(plain_form, config)(params, images, cams, root=root)
        assert np.isfinite(expected.layers).all()
        _hand_back(monkeypatch, found)
        apart = []
        for result in (
            poem.apply(params, images, cams, config=config, root_world=root),
            inference.infer(inference.prepare(params, config), images, cams, root_world=root),
        ):
            np.testing.assert_allclose(result.keypoints_px, expected.keypoints_px, atol=1e-3)
            np.testing.assert_allclose(result.heat_maps, expected.heat_maps, atol=1e-5)
            apart.append(np.linalg.norm(result.layers_world - expected.layers, axis=-1).max())
        print(f"{[f'{distance:.1e}' for distance in apart]} m")
        return apart

    yield compare
    _forget_programs()


def _cast(tree, dtype):
    arrays = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda a: a.astype(dtype) if a.dtype.kind == "f" else a, arrays)


def _plain(plain_form, config):
    """The plain form, compiled without optimisation, which is quicker."""
    return jax.jit(
        functools.partial(plain_form.plain_forward, config=config),
        compiler_options={"xla_backend_optimization_level": 0},
    )


def _hand_back(monkeypatch, found) -> None:
    """Let the optimised form read the neighbours that the plain form found: a rounding may choose others."""
    _forget_programs()
    sets = itertools.cycle(found)

    def nearest_neighbours(queries, points, k) -> Neighbours:
        index = next(sets)
        assert index.shape == (*queries.shape[:2], k)
        return Neighbours(jnp.moveaxis(index, -1, 0), jnp.moveaxis(gather(points, index), 2, 0))

    monkeypatch.setattr("poem_jax.models.decoder.nearest_neighbours", nearest_neighbours)


def _forget_programs() -> None:
    """Programs hold the neighbours that they were traced with."""
    poem._predict.clear_cache()
    inference._find.clear_cache()
    inference._one_thread.cache_clear()


def test_paper(compare, micro_config):
    assert max(compare(micro_config)) < 1e-5


@pytest.mark.parity
def test_paper_hrnet(compare, hrnet_config):
    assert max(compare(hrnet_config)) < 1e-5


@pytest.mark.parity
def test_paper_parametric(compare, parametric_config):
    assert max(compare(parametric_config)) < 1e-5


def test_release(compare, micro_config):
    assert max(compare(_like_release(micro_config))) < 1e-5


@pytest.mark.parity
def test_release_parametric_of_one_view(compare, micro_config):
    config = _like_release(micro_config, DecoderOutput.HAND_PARAMETERS)
    assert max(compare(config, views=1)) < 1e-5


def test_tiny(compare, micro_config):
    """In float64: its queries start at triangulated joints, which random heat maps determine badly."""
    with jax.enable_x64(True):
        assert max(compare(_like_tiny(micro_config), dtype=np.float64)) < 1e-7


def test_neighbours_may_be_given(plain_form, micro_config, make_params, make_scene):
    params, (images, cams) = make_params(micro_config), make_scene(2, VIEWS)
    run = _plain(plain_form, micro_config)
    expected, found = run(params, images, cams)
    again, used = run(params, images, cams, neighbours=found)
    np.testing.assert_array_equal(found, used)
    np.testing.assert_allclose(again.layers, expected.layers, atol=1e-6)
    others, _ = run(params, images, cams, neighbours=[63 - index for index in found])
    assert np.abs(others.layers - expected.layers).max() > 1e-4


@pytest.mark.parity
@pytest.mark.parametrize(
    ("name", "largest"),
    [("v2-base", 1e-5), ("v2-medium-release", 1e-5), ("v2-medium-mano-release", 1e-4)],
)
def test_full_size(compare, name, largest):
    config = preset(name)
    assert max(compare(config, views=2)) < largest
