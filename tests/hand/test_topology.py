import jax.numpy as jnp
import numpy as np

from poem_jax.hand import topology as t


def test_counts_agree():
    assert t.NUM_QUERIES == 799
    assert len(t.JOINT_NAMES) == len(set(t.JOINT_NAMES)) == t.NUM_JOINTS
    assert len(t.SKELETON_JOINT_NAMES) == len(t.MANO_PARENTS) == t.NUM_SKELETON_JOINTS
    assert sorted(t.OPENPOSE_FROM_MANO) == list(range(t.NUM_JOINTS))
    # A closed surface but for one loop: V - E + F = 1 with E = (3 F + loop) / 2.
    edges = (3 * t.NUM_FACES + t.NUM_WRIST_EDGES) / 2
    assert t.NUM_VERTICES - edges + t.NUM_FACES == 1


def test_joint_orders_are_each_others_inverse():
    order = np.array(t.OPENPOSE_FROM_MANO)
    np.testing.assert_array_equal(order[np.array(t.SKELETON_FROM_OPENPOSE)], np.arange(16))
    assert t.JOINT_NAMES[t.ROOT_JOINT] == "middle_mcp"
    assert t.SKELETON_JOINT_NAMES[13:] == ("thumb_cmc", "thumb_mcp", "thumb_ip")


def test_bones_follow_the_skeletons_tree():
    names = {name: i for i, name in enumerate(t.JOINT_NAMES)}
    parents = {child: parent for parent, child in t.BONES}
    for j, parent in enumerate(t.MANO_PARENTS):
        if parent >= 0:
            child = names[t.SKELETON_JOINT_NAMES[j]]
            assert parents[child] == names[t.SKELETON_JOINT_NAMES[parent]]
    assert len(t.BONES) == 20
    assert set(parents) == set(range(1, 21))


def test_query_layouts_split_what_they_join(rng, batch):
    vertices, joints = rng.normal(size=(*batch, 778, 3)), rng.normal(size=(*batch, 21, 3))
    for join, split in (
        (t.join_vertices_first, t.split_vertices_first),
        (t.join_joints_first, t.split_joints_first),
    ):
        queries = join(vertices, joints)
        assert queries.shape == (*batch, 799, 3)
        for got, expected in zip(split(queries), (vertices, joints), strict=True):
            np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(t.join_vertices_first(vertices, joints)[..., 0, :], vertices[..., 0, :])
    np.testing.assert_array_equal(t.join_joints_first(vertices, joints)[..., 0, :], joints[..., 0, :])


def test_layouts_follow_the_array_type():
    assert isinstance(t.join_joints_first(np.zeros((778, 3)), np.zeros((21, 3))), np.ndarray)
    assert not isinstance(t.join_joints_first(jnp.zeros((778, 3)), jnp.zeros((21, 3))), np.ndarray)
