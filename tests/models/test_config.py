import json
from dataclasses import replace
from pathlib import Path

import pytest

from poem_jax.models.config import (
    AggregationConfig,
    BasisConfig,
    Config,
    DecoderConfig,
    Design,
    FeatureConfig,
    FirstQueries,
    HRNetConfig,
    NeighbourSearch,
    ResNetConfig,
    RootConfig,
    Similarity,
)
from poem_jax.models.presets import PRESETS, preset
from poem_jax.weights.config_json import from_json, to_json


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_json_gives_the_config_back(name):
    config = preset(name)
    assert from_json(to_json(config)) == config
    assert hash(from_json(to_json(config))) == hash(config)


def test_unknown_preset_is_named():
    with pytest.raises(ValueError, match=r"`name` must be one of .*'v2-base'.*; got 'v3'"):
        preset("v3")


def test_unknown_key_fails():
    text = json.loads(to_json(preset("tiny")))
    text["decoder"]["num_heds"] = 4
    with pytest.raises(ValueError, match=r"`config.decoder` has unknown keys \['num_heds'\]"):
        from_json(json.dumps(text))


def test_unknown_trunk_fails():
    text = json.loads(to_json(preset("tiny")))
    text["backbone"]["kind"] = "VGG"
    with pytest.raises(ValueError, match=r"`config.backbone.kind` must be one of .*; got 'VGG'"):
        from_json(json.dumps(text))


def test_unknown_choice_fails():
    text = json.loads(to_json(preset("tiny")))
    text["aggregation"]["similarity"] = "cosine"
    message = r"`config.aggregation.similarity` must be one of \['dot', 'mean', 'equal'\]; got 'cosine'"
    with pytest.raises(ValueError, match=message):
        from_json(json.dumps(text))


@pytest.mark.parametrize(
    ("features", "root", "got"),
    [
        (FeatureConfig(stride=8), RootConfig(stride=4), "paper of 8 and paper of 4"),
        (
            FeatureConfig(stride=16, design=Design.RELEASE),
            RootConfig(stride=16),
            "release of 16 and paper of 16",
        ),
        (FeatureConfig(), RootConfig(design=Design.RELEASE), "paper of 8 and release of 8"),
    ],
)
def test_heat_maps_join_only_features_like_them(features, root, got):
    with pytest.raises(ValueError, match=f"`features.heat_maps` needs .* got {got}"):
        Config(features=replace(features, heat_maps=True), root=root)


def test_equal_views_are_the_papers():
    with pytest.raises(ValueError, match=r"needs `aggregation\.design` = paper"):
        AggregationConfig(similarity=Similarity.EQUAL, design=Design.RELEASE)


EARLIER_TINY = replace(
    preset("tiny"),
    root=replace(preset("tiny").root, stride=8),
    features=FeatureConfig(),
    aggregation=AggregationConfig(similarity=Similarity.MEAN),
    joint_decoder=None,
    decoder=replace(preset("tiny").decoder, neighbour_search=NeighbourSearch.ONCE),
)
"""`tiny` as it was first shipped."""
EARLIER = json.loads((Path(__file__).parent / "configs_of_earlier_versions.json").read_text())


@pytest.mark.parametrize("name", sorted(EARLIER))
def test_configs_of_earlier_versions_are_read(name):
    """Before parts named their design, every choice was a field; the crops were not told.

    Those who trained a model of the paper then had nothing but synthetic captures, cut at 1.5.
    """
    then = EARLIER_TINY if name == "tiny" else preset(name)
    crop = preset(name).crop if name.endswith("release") else preset("tiny").crop
    assert from_json(json.dumps(EARLIER[name])) == replace(then, crop=crop)


def test_configs_of_the_first_version_are_read():
    text = json.loads(json.dumps(EARLIER["tiny"]))
    text["similarity"] = text.pop("aggregation")["similarity"]
    text["feature_stride"] = text.pop("features")["stride"]
    del text["root"]["sum_epsilon"]
    assert from_json(json.dumps(text)) == EARLIER_TINY


def test_an_earlier_config_that_mixes_designs_is_refused():
    text = json.loads(json.dumps(EARLIER["v2-medium-release"]))
    text["decoder"]["first_attention"] = "queries"
    with pytest.raises(ValueError, match=r"`config.decoder` must follow the paper or the release"):
        from_json(json.dumps(text))


def test_models_tell_the_crops_that_they_were_trained_on():
    ratios = {name: preset(name).crop.ratio for name in PRESETS}
    assert ratios == {name: 1.5 if name in ("tiny", "v2-nano") else 2.0 for name in PRESETS}


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("width", 16.0, r"`config.width` must be of type int; got 16.0"),
        ("width", True, r"`config.width` must be of type int; got True"),
        ("image_hw", [32], r"`config.image_hw` must have 2 entries; got \[32\]"),
        ("image_hw", 32, r"`config.image_hw` must be a list; got 32"),
        ("image_hw", [32, 32.5], r"`config.image_hw.1` must be of type int; got 32.5"),
        ("image_mean", "half", r"`config.image_mean` must be of type float; got 'half'"),
        ("decoder", 3, r"`config.decoder` must be an object; got 3"),
        ("backbone", None, r"`config.backbone` must be an object; got None"),
        ("decoder.num_layers", 0, r"`num_layers` must be whole and at least 1; got 0"),
        ("decoder.embed_coordinates", 1, r"`config.decoder.embed_coordinates` must be of type bool; got 1"),
    ],
)
def test_values_of_the_wrong_type_fail(where, value, message):
    text = json.loads(to_json(preset("tiny")))
    *owners, name = where.split(".")
    owner = text[owners[0]] if owners else text
    owner[name] = value
    with pytest.raises(ValueError, match=message):
        from_json(json.dumps(text))


def test_a_whole_number_is_a_good_float():
    text = json.loads(to_json(preset("tiny")))
    text["image_std"] = 1
    assert from_json(json.dumps(text)) == preset("tiny")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Config(image_hw=(0, 32)), "`image_hw` must be whole and at least 1"),
        (lambda: Config(image_std=0.0), "`image_std` positive; got 0.5, 0.0"),
        (lambda: DecoderConfig(num_layers=0), "`num_layers` must be whole and at least 1; got 0"),
        (lambda: DecoderConfig(num_layers=10**12), "`num_layers` must be at most 256; got 1000000000000"),
        (lambda: BasisConfig(num_points=10**12), "`num_points` must be at most 65536; got 1000000000000"),
        (lambda: HRNetConfig(modules=(1, 4, 10**12)), "`modules` must be at most 256"),
        (lambda: ResNetConfig((1,) * 1000, (8,) * 1000), "`channels` must name at most 256; got 1000"),
        (lambda: DecoderConfig(num_neighbours=0), "`num_neighbours` must be whole"),
        (lambda: BasisConfig(num_points=0), "`num_points` must be whole"),
        (lambda: BasisConfig(radius=-0.1), "`radius` must be positive and finite, metres; got -0.1"),
        (lambda: ResNetConfig(blocks=(1, 0), channels=(8, 8)), "`blocks` must be whole"),
        (lambda: HRNetConfig(width=0), "`width` must be whole"),
        (lambda: Config(image_hw=(250, 256)), "`image_hw` must be multiples"),
        (lambda: Config(features=FeatureConfig(stride=7)), "`features.stride` must be one of"),
        (lambda: Config(root=RootConfig(stride=3)), "`root.stride` must be one of"),
        (lambda: Config(width=100), "`width` must be a multiple"),
        (lambda: Config(basis=BasisConfig(num_points=16)), "`num_neighbours` must not exceed"),
        (lambda: RootConfig(num_joints=16), "`num_joints` must be 1"),
        (lambda: ResNetConfig(blocks=(1, 2)), "must name the same stages"),
        (
            lambda: Config(decoder=DecoderConfig(first_queries=FirstQueries.JOINTS)),
            "`first_queries` = joints needs",
        ),
    ],
)
def test_rules_are_checked_on_construction(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_configs_are_immutable():
    config = preset("v2-base")
    with pytest.raises(AttributeError):
        config.width = 3  # pyright: ignore[reportAttributeAccessIssue]
    assert replace(config, width=128) == preset("v2-small")


@pytest.mark.parametrize(
    ("value", "message"), [(3, "must be an object"), ({"kind": "Other"}, "must be one of")]
)
def test_a_part_that_may_be_absent_is_whole_or_null(value, message):
    text = json.loads(to_json(preset("tiny")))
    assert from_json(json.dumps({**text, "joint_decoder": None})) == replace(
        preset("tiny"), joint_decoder=None
    )
    with pytest.raises(ValueError, match=f"`config.joint_decoder.*{message}"):
        from_json(json.dumps({**text, "joint_decoder": value}))


def test_a_trunk_may_not_be_absent():
    text = json.loads(to_json(preset("tiny")))
    with pytest.raises(ValueError, match=r"`config\.backbone` must be an object; got None"):
        from_json(json.dumps({**text, "backbone": None}))


def test_a_stem_has_a_block_that_widens_and_others():
    with pytest.raises(ValueError, match="`stem_blocks` must be at least 2; got 1"):
        HRNetConfig(stem_blocks=1)
