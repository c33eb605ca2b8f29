"""The released POEM v2 (medium: width 256), evaluation only, in PyTorch.

What is odd here is the release's: samples read as other numbers than they are (`Head._basis_features`), two
attentions that both read the basis points, one of them named `attn`, and fixed neighbours in the first block.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
import torch.nn.functional as F  # pyright: ignore[reportMissingImports]
from torch import Tensor, nn  # pyright: ignore[reportMissingImports]

from .layers import (
    NUM_JOINTS,
    NUM_QUERIES,
    ROOT_JOINT,
    ConvBlock,
    VectorAttention,
    doubled,
    expected_pixels,
    nearest,
    projected,
    rows_of,
    sampled,
    similar_sum,
    top_down,
    triangulate,
    two_layers,
    view_row_column_code,
)
from .trunks import HRNet

RADIUS = 0.1
"""Metres. Of the ball of basis points, and the unit of the decoder's coordinates."""
_NUM_BLOCKS, _NUM_HEADS, _NUM_NEIGHBOURS = 3, 4, 32
_NORM_EPSILON = 1e-12
_MAP_CHANNELS = 160


class Constants(NamedTuple):
    """What the release reads from files."""

    basis_points: Tensor
    """(4096, 3), metres."""
    anchor_points: Tensor
    """(32, 3), in units of `RADIUS`."""
    anchor_indices: Tensor
    """(32,), int64."""
    template: Tensor
    """Query points of the flat mean hand about joint 9, (799, 3), metres."""

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "Constants":
        """Take arrays of these names, with any leading axes of 1."""
        given = {name: torch.from_numpy(np.asarray(arrays[name])) for name in cls._fields}
        return cls(
            given["basis_points"].reshape(-1, 3),
            given["anchor_points"].reshape(-1, 3),
            given["anchor_indices"].long().flatten(),
            given["template"],
        )


class Found(NamedTuple):
    """The result."""

    layers: Tensor
    """Query points after every block, (block, sample, 799, 3), metres in the master camera's frame."""
    keypoints_px: Tensor
    """(view of any sample, joint, 2)."""
    reference_joints: Tensor
    """Triangulated joints, or those that were given, (sample, 21, 3)."""


class PoemV2(nn.Module):
    """The whole network."""

    def __init__(self, constants: Constants, width: int = 256) -> None:
        super().__init__()
        self.img_backbone = HRNet()
        self.feat_delayer = nn.ModuleList(ConvBlock(c, 2 * c, 3, 2) for c in (40, 80, 160))
        self.feat_in = ConvBlock(320, _MAP_CHANNELS, 1, plain=True)
        self.uv_delayer = nn.ModuleList(ConvBlock(3 * c, c, 3) for c in (160, 80, 40))
        self.uv_out = ConvBlock(40, NUM_JOINTS, 1, plain=True)
        self.ptEmb_head = Head(constants, width)

    def forward(
        self, images: Tensor, K: Tensor, E: Tensor, views: Sequence[int], joints: Tensor | None = None
    ) -> Found:
        """Reconstruct one hand per sample.

        Args:
            images: views of all samples, one after the other, (view, 3, 256, 256), -0.5 to 0.5.
            K: intrinsics (view, 3, 3).
            E: camera to the sample's first camera, (view, 4, 4).
            views: how many views each sample has.
            joints: (sample, 21, 3); what is read where every sample has one view.
        """
        levels = self.img_backbone(images)
        maps = self.feat_in(self._bottom_up(levels))
        heat = self.uv_out(F.max_pool2d(top_down(levels, self.uv_delayer), 2))
        keypoints_px = expected_pixels(heat)
        if max(views) > 1:
            split = [x.split(list(views)) for x in (keypoints_px, K, E)]
            joints = torch.stack(list(map(triangulate, *split)))
        assert joints is not None, "a single view needs the true joints"
        return Found(self.ptEmb_head(maps, joints[:, ROOT_JOINT], K, E, views), keypoints_px, joints)

    def _bottom_up(self, levels: list[Tensor]) -> Tensor:
        """Fuse the trunk's maps into (view, 320, 16, 16)."""
        x = levels[0]
        for block, coarser in zip(self.feat_delayer, levels[1:], strict=True):
            x = block(x) + coarser
        return doubled(x)


class Head(nn.Module):
    """From feature maps to query points."""

    def __init__(self, constants: Constants, width: int) -> None:
        super().__init__()
        self.width = width
        self.input_proj = nn.Conv2d(_MAP_CHANNELS, width, 1)
        self.adapt_pos3d = nn.Conv2d(3 * width // 2, width, 1)
        theta, phi = two_layers(width, width, width // 2), two_layers(width // 2, width // 2, width)
        self.merge_net_feature = nn.ModuleList([theta, phi])
        self.query_feat_embedding = nn.Embedding(NUM_QUERIES, width)
        self.transformer = Transformer(constants, width)
        self.register_buffer("basis_points", constants.basis_points, persistent=False)
        self.register_buffer("template", constants.template, persistent=False)

    def forward(self, maps: Tensor, centre: Tensor, K: Tensor, E: Tensor, views: Sequence[int]) -> Tensor:
        """Return the query points after every block, (block, sample, 799, 3), metres.

        `maps` (view, 160, 16, 16), `centre` (sample, 3), the others as in `PoemV2.forward`.
        """
        h, w = maps.shape[-2:]
        codes = torch.cat([view_row_column_code(n, h, w, self.width // 2) for n in views])
        if maps.is_contiguous(memory_format=torch.channels_last):
            codes = codes.contiguous(memory_format=torch.channels_last)
        maps = self.input_proj(maps) + self.adapt_pos3d(codes)

        basis = self.basis_points + centre[:, None]
        counts = torch.tensor(views)
        read = sampled(maps, projected(basis.repeat_interleave(counts, 0), K, E))
        features = torch.stack([self._basis_features(sample) for sample in read.split(list(views))])

        points = (basis - centre[:, None]) / RADIUS
        queries = (self.template / RADIUS).expand(len(views), -1, -1)
        embeddings = self.query_feat_embedding.weight.expand(len(views), -1, -1)
        moved = torch.stack(self.transformer(embeddings, queries, features, points))
        return torch.nan_to_num(moved) * RADIUS + centre[:, None]

    def _basis_features(self, read: Tensor) -> Tensor:
        """Merge the views of one sample: (view, c, point) to (point, c).

        The memory of (view, c, point) is read as (point, view, c), which is no transposition.
        """
        views, c, points = read.shape
        theta, phi = self.merge_net_feature
        tokens = read.reshape(points, views, c)
        mapped = theta(tokens)
        if views == 1:
            return (tokens + phi(mapped))[:, 0]
        return tokens[:, 0] + phi(similar_sum(mapped)) / views


class Transformer(nn.Module):
    """The blocks."""

    def __init__(self, constants: Constants, width: int) -> None:
        super().__init__()
        self.pt_metro_encoder = nn.ModuleList(
            Block(width, is_last=i == _NUM_BLOCKS - 1) for i in range(_NUM_BLOCKS)
        )
        self.register_buffer("anchor_points", constants.anchor_points, persistent=False)
        self.register_buffer("anchor_indices", constants.anchor_indices, persistent=False)

    def forward(self, embeddings: Tensor, queries: Tensor, features: Tensor, points: Tensor) -> list[Tensor]:
        """Return the query points after every block, each (batch, 799, 3).

        Args:
            embeddings: of the queries (batch, 799, c).
            queries: their coordinates (batch, 799, 3).
            features: of the basis points (batch, 4096, c).
            points: their coordinates (batch, 4096, 3).
        """
        anchors = (
            self.anchor_indices.expand(len(queries), 1, -1),
            self.anchor_points.expand(len(queries), 1, -1, -1),
        )
        moved = []
        for i, block in enumerate(self.pt_metro_encoder):
            near = [anchors] * 2 if i == 0 else [_neighbours(queries, cloud) for cloud in (queries, points)]
            embeddings, queries = block(embeddings, queries, features, near)
            moved.append(queries)
        return moved


Near = tuple[Tensor, Tensor]
"""Numbers (batch, query, k) and coordinates (batch, query, k, 3) of neighbours; a query axis of 1 where all
queries have the same."""


def _neighbours(queries: Tensor, points: Tensor) -> Near:
    index = nearest(queries, points, _NUM_NEIGHBOURS)
    return index, rows_of(points, index)


class Block(nn.Module):
    """One linear map of queries and basis points, then the layer proper."""

    def __init__(self, width: int, *, is_last: bool) -> None:
        super().__init__()
        self.embedding = nn.Linear(width, width)
        self.encoder = Encoder(width, is_last=is_last)

    def forward(
        self, embeddings: Tensor, queries: Tensor, features: Tensor, near: list[Near]
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings and query points afterwards; `near`: among the queries, and of the basis."""
        return self.encoder(self.embedding(embeddings), queries, self.embedding(features), near)


class Encoder(nn.Module):
    """Two attentions to the basis points, vector attention, and a feed-forward network unless it is last,
    where nobody reads what it gives."""

    def __init__(self, width: int, *, is_last: bool) -> None:
        super().__init__()
        self.attn, self.cross_attn = Attention(width), Attention(width)
        self.vec_attn = PointAttention(width)
        self.is_last = is_last
        if not is_last:
            self.intermediate = nn.ModuleDict({"dense": nn.Linear(width, 4 * width)})
            self.output = AddAndNorm(4 * width, width)

    def forward(
        self, embeddings: Tensor, queries: Tensor, features: Tensor, near: list[Near]
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings and query points afterwards."""
        embeddings = self.cross_attn(self.attn(embeddings, features), features)
        embeddings, queries = self.vec_attn(embeddings, queries, features, near)
        if self.is_last:
            return embeddings, queries
        return self.output(F.gelu(self.intermediate["dense"](embeddings)), embeddings), queries


class AddAndNorm(nn.Module):
    """LayerNorm(residual + linear(x))."""

    def __init__(self, c_in: int, width: int) -> None:
        super().__init__()
        self.dense = nn.Linear(c_in, width)
        self.LayerNorm = nn.LayerNorm(width, eps=_NORM_EPSILON)

    def forward(self, x: Tensor, residual: Tensor) -> Tensor:
        """Map x (batch, query, c_in), add it to the residual (batch, query, c) and normalise."""
        return self.LayerNorm(self.dense(x) + residual)


class Attention(nn.Module):
    """Multi-head attention with the residual sum and the norm after it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.self = nn.ModuleDict({name: nn.Linear(width, width) for name in ("query", "key", "value")})
        self.output = AddAndNorm(width, width)

    def forward(self, queries: Tensor, tokens: Tensor) -> Tensor:
        """Let queries (batch, query, c) read tokens (batch, token, c)."""
        q, k, v = (
            self.self[name](x).unflatten(-1, (_NUM_HEADS, -1)).transpose(1, 2)
            for name, x in (("query", queries), ("key", tokens), ("value", tokens))
        )
        logits = q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5
        read = torch.softmax(logits, -1) @ v
        return self.output(read.transpose(1, 2).flatten(2), queries)


class PointAttention(nn.Module):
    """Vector attention among the queries, then to the basis points; then the queries move."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query_self_attn, self.query_cross_attn = VectorAttention(width), VectorAttention(width)
        self.reg_branch = two_layers(width, width, 3)

    def forward(
        self, embeddings: Tensor, queries: Tensor, features: Tensor, near: list[Near]
    ) -> tuple[Tensor, Tensor]:
        """Return embeddings and query points afterwards."""
        among, of_basis = near
        embeddings = self.query_self_attn.among(embeddings, queries, *among)
        embeddings = self.query_cross_attn.across(embeddings, queries, features, *of_basis)
        return embeddings, queries + self.reg_branch(embeddings)
