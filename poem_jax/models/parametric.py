"""Parametric output: pose and shape of the hand model from the decoder's last embeddings."""

from typing import NamedTuple

import jax.numpy as jnp
from flax import nnx

from poem_jax.geometry.transforms import rotation_from_6d
from poem_jax.hand.model import HandMesh, HandModel
from poem_jax.hand.topology import NUM_QUERIES, NUM_SHAPES, NUM_SKELETON_JOINTS, ROOT_JOINT
from poem_jax.models.config import Layout
from poem_jax.models.linear import Linear
from poem_jax.typing import Array, Float

_IDENTITY_6D = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_SMALL = 1e-2
"""Scale of the first weights: training starts near the flat mean hand."""


class HandParameters(NamedTuple):
    """What a parametric decoder regresses."""

    rotations: Float[Array, "batch 16 3 3"]
    """Of each skeleton joint relative to its parent, MANO order; the first turns into the primary camera."""
    shape: Float[Array, "batch 10"]


class ParameterRegressor(nnx.Module):
    """Learned pooling over the queries, then one linear layer to 16 6D rotations and 10 coefficients."""

    def __init__(self, width: int, layout: Layout = Layout.BY_NAME, *, rngs: nnx.Rngs) -> None:
        self.layout = layout
        self.pool = Linear(NUM_QUERIES, 1, rngs=rngs)
        numbers = NUM_SKELETON_JOINTS * len(_IDENTITY_6D) + NUM_SHAPES
        self.regress = Linear(width, numbers, rngs=rngs)
        self.regress.kernel = nnx.Param(_SMALL * self.regress.kernel[...])
        flat_hand = jnp.concatenate(
            [jnp.tile(jnp.array(_IDENTITY_6D), NUM_SKELETON_JOINTS), jnp.zeros(NUM_SHAPES)]
        )
        self.regress.bias = nnx.Param(flat_hand)

    def __call__(self, embeddings: Float[Array, "batch query c"]) -> HandParameters:
        """Regress the parameters."""
        if self.layout is Layout.BY_NAME:
            channels = jnp.swapaxes(embeddings, -1, -2)
        else:
            channels = embeddings.reshape(embeddings.shape[0], embeddings.shape[-1], NUM_QUERIES)
        numbers = self.regress(self.pool(channels)[..., 0])
        sixd, shape = jnp.split(numbers, [NUM_SKELETON_JOINTS * len(_IDENTITY_6D)], -1)
        return HandParameters(
            rotation_from_6d(sixd.reshape(-1, NUM_SKELETON_JOINTS, len(_IDENTITY_6D))), shape
        )


def root_relative_mesh(hand: HandModel, parameters: HandParameters) -> HandMesh:
    """Return the hand about its root joint, metres."""
    mesh = hand.shape(parameters.shape).pose_rotations(parameters.rotations).skin()
    root = mesh.joints[..., ROOT_JOINT, None, :]
    return HandMesh(mesh.vertices - root, mesh.joints - root)
