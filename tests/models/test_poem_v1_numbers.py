"""The numbers of the paper and of FACTS_v1 that POEM v1 and its ablations stand on, one by one."""

import operator

import pytest

from poem_jax.hand.topology import NUM_JOINTS, QueryOrder
from poem_jax.models.config import Design, FrozenNorms
from poem_jax.models.frustum_config import Cuboid, DepthSteps
from poem_jax.models.poem_v1_config import (
    BasisFeatures,
    OneStageConfig,
    QueryEmbedding,
    RootSpace,
    in_cuboid,
)
from poem_jax.models.presets import CUBOIDS, preset, released

DEXYCB = Cuboid((-1.2, -1.2, 0.2), (1.2, 1.2, 2.0))
HO3D = Cuboid((-0.6, -0.6, 0.0), (0.6, 0.6, 1.2))
OAKINK = Cuboid((-1.0, -1.0, 0.0), (1.0, 1.0, 1.5))
PAPER = ("v1", "v1-1stage", "v1-wo-proj", "v1-wo-pt", "v1-g-emb", "v1-gv-emb")
RELEASED = ("v1-release-dexycb", "v1-release-ho3d", "v1-release-oakink")
BOTH = {
    "image_hw": (256, 256),
    "image_mean": 0.5,
    "image_std": 1.0,
    "width": 256,
    "stride": 8,
    "map_hw": (32, 32),
    "backbone.blocks": (3, 4, 6, 3),
    "backbone.channels": (64, 128, 256, 512),
    "basis.num_points": 4096,
    "basis.frustum.num_depths": 32,
}
TABLE = {
    **{
        (name, field): value
        for names, fields in (
            (PAPER, {"design": Design.PAPER, "basis.radius": 0.1, "query_order": QueryOrder.VERTICES_FIRST}),
            (
                RELEASED,
                {"design": Design.RELEASE, "basis.radius": 0.2, "query_order": QueryOrder.JOINTS_FIRST},
            ),
        )
        for name in names
        for field, value in {**BOTH, **fields}.items()
    },
    **{
        (name, field): value
        for name in (*PAPER, *RELEASED)
        if name != "v1-wo-pt"
        for field, value in {"decoder.num_layers": 6, "decoder.num_neighbours": 16}.items()
    },
    **{
        (name, field): value
        for name in PAPER
        for field, value in {
            "basis.frustum.steps": DepthSteps.LINEAR_INCREASING,
            "basis.frustum.start": 0.2,
            "basis.frustum.end": 2.0,
            "basis.frustum.cell_offset": 0.5,
            "backbone.frozen_norms": FrozenNorms.NONE,
        }.items()
    },
    **{
        (name, field): value
        for name, cuboid in zip(RELEASED, (DEXYCB, HO3D, OAKINK), strict=True)
        for field, value in {
            "space": cuboid,
            "basis.frustum.steps": DepthSteps.LINEAR,
            "basis.frustum.start": cuboid.low[2],
            "basis.frustum.end": cuboid.high[2],
            "basis.frustum.cell_offset": 0.0,
            "branch_stride": 4,
            "backbone.frozen_norms": FrozenNorms.STAGE_STARTS,
            "first_stage.cell_offset": 0.0,
            "first_stage.sum_epsilon": 1e-6,
            "needs_all_joints": True,
            "takes_root": False,
        }.items()
    },
    **{(name, "first_stage.num_joints"): NUM_JOINTS for name in (*PAPER, *RELEASED) if name != "v1-1stage"},
    **{(name, "space"): RootSpace() for name in PAPER if name != "v1-1stage"},
    **{(name, "decoder.num_heads"): 4 for name in PAPER if name != "v1-wo-pt"},
    ("v1-1stage", "space"): DEXYCB,
    ("v1-1stage", "first_stage"): OneStageConfig(),
    ("v1-wo-proj", "basis_features"): BasisFeatures.OWN_CAMERA,
    ("v1-wo-pt", "grid_draw"): None,
    ("v1-wo-pt", "decoder.cuboid"): DEXYCB,
    ("v1-wo-pt", "decoder.detr.num_layers"): 6,
    ("v1-wo-pt", "decoder.detr.num_heads"): 8,
    ("v1-wo-pt", "decoder.detr.ffn_width"): 2048,
    ("v1-wo-pt", "decoder.detr.dropout"): 0.1,
    ("v1", "query_embedding"): QueryEmbedding.VERTEX,
    ("v1-g-emb", "query_embedding"): QueryEmbedding.GLOBAL,
    ("v1-gv-emb", "query_embedding"): QueryEmbedding.GLOBAL_AND_VERTEX,
}


def test_every_number_is_in_its_preset():
    found = {(name, field): operator.attrgetter(field)(preset(name)) for name, field in TABLE}
    assert found == TABLE


def test_released_ablations_have_their_embeddings():
    kinds = {
        "v1": QueryEmbedding.VERTEX,
        "v1-g-emb": QueryEmbedding.GLOBAL,
        "v1-gv-emb": QueryEmbedding.GLOBAL_AND_VERTEX,
        "v1-full-emb": QueryEmbedding.POINTS,
        "v1-wo-proj": QueryEmbedding.POINT_CODES,
    }
    assert {variant: released(variant).query_embedding for variant in kinds} == kinds


@pytest.mark.parametrize("name", PAPER)
def test_the_paper_s_models_move_to_another_cuboid(name):
    config, moved = preset(name), in_cuboid(preset(name), CUBOIDS["ho3d"])
    assert (moved.basis.frustum.start, moved.basis.frustum.end) == (0.0, 1.2)
    assert isinstance(moved.space, RootSpace) if name != "v1-1stage" else moved.space == HO3D
    assert name != "v1-wo-pt" or moved.decoder.cuboid == HO3D
    assert in_cuboid(moved, DEXYCB) == config
