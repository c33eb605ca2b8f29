"""Joint decoder: the joint queries move first, each by basis points of its own (ours, not the paper's).

Triangulation joins the views by one point per heat map. A map says more: it is wide, or has two peaks, where
the view does not know. Here every joint carries a small cloud of basis points, laid out in the hand's own
frame; each point is given what the views' heat maps say of that joint there, the joints read each other, and
move. After every layer the clouds stand at the new places and read the maps again.

The hand's frame is spanned by palm and knuckles. Written in it, a layer is the same for every orientation of
hand and cameras and need not learn them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from poem_jax.geometry.cameras import Cameras, project
from poem_jax.geometry.sampling import sample_bilinear
from poem_jax.geometry.transforms import matmul, rotate_points, transpose
from poem_jax.hand.topology import NUM_JOINTS, ROOT_JOINT
from poem_jax.models.config import JointDecoderConfig
from poem_jax.models.decoder import MultiHeadAttention
from poem_jax.models.hand_output import palm_frame
from poem_jax.models.layers import layer_norm, linear, normal
from poem_jax.models.point_features import projected_features
from poem_jax.typing import Array, Bool, Float

_EPSILON = 1e-5
"""Of the layer norms."""
_OFFSET_M = 0.01
"""Offsets are regressed in centimetres."""
_EMBEDDING_SCALE = 0.3
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
_AXES = np.concatenate([np.eye(3), -np.eye(3)])


class JointDecoder(nnx.Module):
    """A row of layers that each move the 21 joints."""

    def __init__(self, config: JointDecoderConfig, map_width: int, radius: float, *, rngs: nnx.Rngs) -> None:
        """`map_width`: channels of the feature maps; `radius`: unit of coordinates, metres."""
        self.radius = radius
        self.layers = nnx.List(JointLayer(config, map_width, rngs=rngs) for _ in range(config.num_layers))

    def __call__(
        self,
        joints: Float[Array, "batch 21 3"],
        evidence: Float[Array, "batch view 21 h w"],
        feature_maps: Float[Array, "batch view h w c"],
        cams: Cameras,
        image_hw: tuple[int, int],
        *,
        training: bool = False,
    ) -> list[Float[Array, "batch 21 3"]]:
        """Return the joints after every layer, in the world of `cams`, metres.

        Args:
            joints: where they start.
            evidence: what each view says of each joint: the logarithm of its heat over an even map's.
            feature_maps: of the same views.
            cams: cameras of these views; masked ones say nothing.
            image_hw: size of the images.
            training: a layer learns from its own step, not from the places that the layers before it gave.
        """
        moved = []
        for layer in self.layers:
            joints = jax.lax.stop_gradient(joints) if training else joints
            to_hand = palm_frame(joints)
            about_root = joints - joints[:, ROOT_JOINT, None]
            clouds = joints[:, :, None] + matmul(cloud(layer.shells_m).astype(joints.dtype), to_hand)[:, None]
            tokens = jnp.concatenate(
                [
                    rotate_points(to_hand, about_root) / self.radius,
                    read_evidence(evidence, cams, clouds, image_hw),
                    layer.pick(_mean(projected_features(feature_maps, cams, joints, image_hw)[0], cams)),
                ],
                -1,
            )
            joints = joints + rotate_points(transpose(to_hand), _OFFSET_M * layer(tokens))
            moved.append(joints)
        return moved


class JointLayer(nnx.Module):
    """Joints read each other and regress their offsets in the hand's frame."""

    def __init__(self, config: JointDecoderConfig, map_width: int, *, rngs: nnx.Rngs) -> None:
        self.shells_m = config.shells_m
        numbers = 3 + len(cloud(config.shells_m)) + config.picked_features
        self.pick = linear(map_width, config.picked_features, rngs=rngs)
        self.embed = nnx.Param(normal(rngs.params(), (NUM_JOINTS, numbers, config.width), numbers**-0.5))
        self.names = nnx.Param(normal(rngs.params(), (NUM_JOINTS, config.width), _EMBEDDING_SCALE))
        self.blocks = nnx.List(Block(config, rngs=rngs) for _ in range(config.num_blocks))
        self.norm = layer_norm(config.width, _EPSILON, rngs=rngs)
        self.offset = nnx.Linear(config.width, 3, kernel_init=nnx.initializers.zeros, rngs=rngs)

    def __call__(self, tokens: Float[Array, "batch 21 number"]) -> Float[Array, "batch 21 3"]:
        """Return the joints' offsets, in centimetres along the axes of the hand's frame."""
        x = jnp.einsum("bjn,jnc->bjc", tokens, self.embed[...]) + self.names[...]
        for block in self.blocks:
            x = block(x)
        return self.offset(self.norm(x))


class Block(nnx.Module):
    """x + attention(norm(x)), then x + feed-forward(norm(x))."""

    def __init__(self, config: JointDecoderConfig, *, rngs: nnx.Rngs) -> None:
        width, hidden = config.width, config.ffn_expansion * config.width
        self.attention = MultiHeadAttention(width, config.num_heads, rngs=rngs)
        self.before_attention, self.before_hidden = (layer_norm(width, _EPSILON, rngs=rngs) for _ in range(2))
        self.hidden, self.out = linear(width, hidden, rngs=rngs), linear(hidden, width, rngs=rngs)

    def __call__(self, x: Float[Array, "batch joint c"]) -> Float[Array, "batch joint c"]:
        """Let the joints read each other."""
        seen = self.before_attention(x)
        x = x + self.attention(seen, seen)
        return x + self.out(jax.nn.gelu(self.hidden(self.before_hidden(x))))


def cloud(shells_m: tuple[float, ...]) -> Float[np.ndarray, "point 3"]:
    """Return the basis points of one joint in the hand's frame, metres about it: its own place, and shells of
    six points along the axes and of eight between them in turn."""
    shells = [radius * (_CORNERS if i % 2 else _AXES) for i, radius in enumerate(shells_m)]
    return np.concatenate([np.zeros((1, 3)), *shells]).astype(np.float32)


def read_evidence(
    evidence: Float[Array, "batch view 21 h w"],
    cams: Cameras,
    clouds_world: Float[Array, "batch 21 point 3"],
    image_hw: tuple[int, int],
) -> Float[Array, "batch 21 point"]:
    """Return what the views say, on average, of each joint at the points of its cloud.

    The mean over views of logarithms of probabilities: of the places that the views could mean, the one that
    all can agree to wins. Points outside an image or behind a camera get zero from it: nothing is said.
    """
    batch, joint, point, _ = clouds_world.shape
    uv_px, depth = project(cams.K, cams.T_cam_from_world, clouds_world.reshape(batch, 1, joint * point, 3))
    h, w = evidence.shape[-2:]
    cells = uv_px * (jnp.array([w, h], uv_px.dtype) / jnp.array(image_hw[::-1], uv_px.dtype))
    by_joint = (*uv_px.shape[:2], joint, point)
    said = sample_bilinear(evidence[..., None], cells.reshape(*by_joint, 2))[..., 0]
    said = jnp.where(depth.reshape(by_joint) > 0, said, 0)
    return _mean(said, cams)


def _mean(values: Float[Array, "batch view *rest"], cams: Cameras) -> Float[Array, "batch *rest"]:
    """Average over the valid views; zero where there is none."""
    mask: Bool[Array, "batch view"] = cams.view_mask
    count = jnp.maximum(jnp.sum(mask, -1), 1).reshape(-1, *[1] * (values.ndim - 2))
    kept = jnp.where(mask.reshape(*mask.shape, *[1] * (values.ndim - 2)), values, 0)
    return jnp.sum(kept, 1) / count.astype(values.dtype)
