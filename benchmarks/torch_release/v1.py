"""The released POEM v1 (trained on DexYCB), evaluation only, in PyTorch.

Basis points are those of the cameras' frustum grids that lie in a ball, the first 4096 in random order. Which
they are can be given, to compare with a stored run.
"""

from typing import NamedTuple

import torch  # pyright: ignore[reportMissingImports]
import torch.nn.functional as F  # pyright: ignore[reportMissingImports]
from torch import Tensor, nn  # pyright: ignore[reportMissingImports]

from .layers import (
    IMAGE_SIZE,
    NUM_JOINTS,
    NUM_QUERIES,
    NUM_VERTICES,
    WRIST,
    ConvBlock,
    VectorAttention,
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
from .trunks import ResNet34

_WIDTH, _MAP_CHANNELS = 256, 128
_NUM_BLOCKS, _NUM_NEIGHBOURS = 6, 16
_NUM_BASIS, _RADIUS, _SHIFT_SCALE = 4096, 0.2, 0.01
"""Number of basis points; radius of their ball, and what its centre's shift is multiplied by, metres."""
_NUM_DEPTHS, _NEAR, _FAR = 32, 0.2, 2.0
_LOW, _HIGH = (-1.2, -1.2, 0.2), (1.2, 1.2, 2.0)
"""Metres in the master camera's frame: coordinates are shares of this cuboid."""
_LOGIT_EPSILON = 1e-5


class Found(NamedTuple):
    """The result."""

    layers: Tensor
    """Query points after every block, (block, sample, 799, 3), metres in the master camera's frame."""
    keypoints_px: Tensor
    """(sample, view, joint, 2)."""
    reference_joints: Tensor
    """Triangulated joints, (sample, 21, 3)."""


class PoemV1(nn.Module):
    """The whole network."""

    def __init__(self) -> None:
        super().__init__()
        self.img_backbone = ResNet34()
        self.feat_delayer, self.uv_delayer = (
            nn.ModuleList(ConvBlock(c_in, c_out, 3) for c_in, c_out in ((768, 256), (384, 128), (192, 64)))
            for _ in range(2)
        )
        self.feat_in = ConvBlock(64, _MAP_CHANNELS, 1, plain=True)
        self.uv_out = ConvBlock(64, NUM_JOINTS, 1, plain=True)
        self.linear_inv_skin = nn.Linear(NUM_JOINTS, NUM_VERTICES)
        self.ptEmb_head = Head()

    def forward(self, images: Tensor, K: Tensor, E: Tensor, ball_index: Tensor | None = None) -> Found:
        """Reconstruct one hand per sample.

        Args:
            images: (sample x view, 3, 256, 256), -0.5 to 0.5.
            K: intrinsics (sample, view, 3, 3).
            E: camera to the sample's first camera, (sample, view, 4, 4).
            ball_index: numbers of the basis points in each sample's grid (view, w, h, depth), flattened,
                (sample, 4096), -1 = none; None = drawn.
        """
        levels = self.img_backbone(images)
        maps = self.feat_in(F.max_pool2d(top_down(levels, self.feat_delayer), 2))
        heat = self.uv_out(F.max_pool2d(top_down(levels, self.uv_delayer), 2))
        keypoints_px = expected_pixels(heat).unflatten(0, K.shape[:2])
        joints = torch.stack([triangulate(*sample) for sample in zip(keypoints_px, K, E, strict=True)])
        start = self._first_mesh(joints)
        return Found(self.ptEmb_head(maps, start, K, E, ball_index), keypoints_px, joints)

    def _first_mesh(self, joints: Tensor) -> Tensor:
        """Append vertices that are weighted sums of the joints: (sample, 21, 3) to (sample, 799, 3)."""
        wrist = joints[:, WRIST, None]
        vertices = self.linear_inv_skin((joints - wrist).transpose(1, 2)).transpose(1, 2)
        return torch.cat([joints, vertices + wrist], 1)


class Head(nn.Module):
    """From feature maps and first query points to query points."""

    def __init__(self) -> None:
        super().__init__()
        half = _WIDTH // 2
        self.input_proj = nn.Conv2d(_MAP_CHANNELS, _WIDTH, 1)
        self.adapt_pos3d = nn.Conv2d(3 * half, _WIDTH, 1)
        self.position_encoder = nn.Sequential(
            nn.Conv2d(3 * _NUM_DEPTHS, 2 * _WIDTH, 1), nn.ReLU(), nn.Conv2d(2 * _WIDTH, _WIDTH, 1)
        )
        self.center_shift_layer = two_layers(NUM_QUERIES, NUM_QUERIES, 1)
        self.merge_net_feature, self.merge_net_query_feature = (
            nn.ModuleList([two_layers(_WIDTH, _WIDTH, half), two_layers(half, half, _WIDTH)])
            for _ in range(2)
        )
        self.reference_embed = nn.Embedding(NUM_QUERIES, _WIDTH)
        self.query_embedding = two_layers(_WIDTH, _WIDTH, _WIDTH)
        self.transformer = Transformer()
        self.reg_branches = nn.ModuleList(two_layers(_WIDTH, _WIDTH, 3) for _ in range(_NUM_BLOCKS))

    def forward(self, maps: Tensor, start: Tensor, K: Tensor, E: Tensor, ball_index: Tensor | None) -> Tensor:
        """Return the query points after every block, (block, sample, 799, 3), metres.

        `maps` (sample x view, 128, h, w), `start` (sample, 799, 3), the others as in `PoemV1.forward`.
        """
        grid = frustum_grid(K, E, *maps.shape[-2:])
        codes = self._codes(grid, maps)
        maps = self.input_proj(maps) + codes
        points = basis_points(grid, self._centre(start), ball_index)

        at_basis = self._places(points, K, E)
        basis = _merged(self.merge_net_feature, self._read(maps, at_basis, K))
        told = self._read(codes, at_basis, K).sum(2)
        queries = _merged(self.merge_net_query_feature, self._read(maps, self._places(start, K, E), K))
        embeddings = queries + self.query_embedding(self.reference_embed.weight)
        moved = self.transformer(
            embeddings, to_shares(start), basis + told, to_shares(points), self.reg_branches
        )
        return to_metres(torch.nan_to_num(torch.stack(moved)))

    def _codes(self, grid: Tensor, maps: Tensor) -> Tensor:
        """Return the codes of all cells' positions (sample x view, c, h, w)."""
        samples, views, w, h = grid.shape[:4]
        logits = inverse_sigmoid(to_shares(grid)).reshape(samples * views, w, h, -1)
        logits, by_number = logits.permute(0, 3, 2, 1), view_row_column_code(views, h, w, _WIDTH // 2)
        layout = torch.contiguous_format
        if maps.is_contiguous(memory_format=torch.channels_last):
            layout = torch.channels_last
        encoded = self.position_encoder(logits.contiguous(memory_format=layout))
        mixed = self.adapt_pos3d(by_number.contiguous(memory_format=layout))
        return encoded + mixed.repeat(samples, 1, 1, 1)

    def _centre(self, start: Tensor) -> Tensor:
        """Return the ball's centre (sample, 3)."""
        shift = self.center_shift_layer(start.transpose(1, 2))[..., 0]
        return start.mean(1) + _SHIFT_SCALE * shift

    @staticmethod
    def _places(points: Tensor, K: Tensor, E: Tensor) -> Tensor:
        """Project (sample, point, 3) into all views: (sample x view, point, 2), for `sampled`."""
        views = K.shape[1]
        return projected(points.repeat_interleave(views, 0), K.flatten(0, 1), E.flatten(0, 1))

    @staticmethod
    def _read(maps: Tensor, places: Tensor, K: Tensor) -> Tensor:
        """Sample the maps of all views: (sample, point, view, c)."""
        return sampled(maps, places).unflatten(0, K.shape[:2]).permute(0, 3, 1, 2)


def _merged(networks: nn.ModuleList, read: Tensor) -> Tensor:
    """Merge the views into the first: (sample, point, view, c) to (sample, point, c)."""
    theta, phi = networks
    return read[:, :, 0] + phi(similar_sum(theta(read)))


# Grids and coordinates.


def frustum_grid(K: Tensor, E: Tensor, h: int, w: int) -> Tensor:
    """Return points on the cells' rays, (sample, view, w, h, depth, 3), metres in the master's frame."""
    depth = _NEAR + (_FAR - _NEAR) / _NUM_DEPTHS * torch.arange(_NUM_DEPTHS)
    u, v = torch.arange(w) * (IMAGE_SIZE / w), torch.arange(h) * (IMAGE_SIZE / h)
    cells = torch.stack(torch.meshgrid(u, v, depth, indexing="ij"), -1)
    scaled = torch.cat([cells[..., :2] * cells[..., 2:], cells[..., 2:]], -1).reshape(-1, 3)
    in_camera = scaled @ torch.linalg.inv(K).transpose(-1, -2)
    points = in_camera @ E[..., :3, :3].transpose(-1, -2) + E[..., None, :3, 3]
    return points.unflatten(2, (w, h, _NUM_DEPTHS))


def basis_points(grid: Tensor, centre: Tensor, ball_index: Tensor | None) -> Tensor:
    """Return (sample, 4096, 3) points of the grids: those of `ball_index`, or drawn from the balls.

    What a ball does not hold stands at the master camera's centre.
    """
    points, index = grid.flatten(1, 4), ball_index
    if index is None:
        points = points[:, torch.randperm(points.shape[1])]
        index = torch.stack([_first_inside(*sample) for sample in zip(points, centre, strict=True)])
    taken = torch.stack([cloud[i.clamp(min=0)] for cloud, i in zip(points, index, strict=True)])
    return taken * (index >= 0)[..., None]


def _first_inside(points: Tensor, centre: Tensor) -> Tensor:
    """Return the numbers of the first points (point, 3) in a ball, -1 behind the last."""
    inside = ((points - centre) ** 2).sum(-1) < _RADIUS**2
    found = inside.nonzero()[:_NUM_BASIS, 0]
    return F.pad(found, (0, _NUM_BASIS - len(found)), value=-1)


def to_shares(points: Tensor) -> Tensor:
    """Turn metres (..., 3) into shares of the cuboid."""
    low, high = torch.tensor(_LOW), torch.tensor(_HIGH)
    return (points - low) / (high - low)


def to_metres(shares: Tensor) -> Tensor:
    """Undo `to_shares`."""
    low, high = torch.tensor(_LOW), torch.tensor(_HIGH)
    return shares * (high - low) + low


def inverse_sigmoid(shares: Tensor) -> Tensor:
    """Return log(x / (1 - x)), x clipped to [0, 1] and both terms to at least 1e-5."""
    x = shares.clamp(0, 1)
    return torch.log(x.clamp(min=_LOGIT_EPSILON) / (1 - x).clamp(min=_LOGIT_EPSILON))


# Decoder.


class Transformer(nn.Module):
    """Basis points read each other once; in every block the queries read each other and the basis points,
    and move. Neighbours are searched anew in every block."""

    def __init__(self) -> None:
        super().__init__()
        self.feats_self_attn = VectorAttention(_WIDTH)
        self.query_self_attn, self.query_feats_cross_attn = (
            nn.ModuleList(VectorAttention(_WIDTH) for _ in range(_NUM_BLOCKS)) for _ in range(2)
        )

    def forward(
        self, embeddings: Tensor, queries: Tensor, features: Tensor, points: Tensor, branches: nn.ModuleList
    ) -> list[Tensor]:
        """Return the query points after every block, each (sample, 799, 3); coordinates are shares.

        Args:
            embeddings: of the queries (sample, 799, c).
            queries: their coordinates (sample, 799, 3).
            features: of the basis points (sample, 4096, c).
            points: their coordinates (sample, 4096, 3).
            branches: from embeddings to offsets of the coordinates' logits, one a block.
        """
        features = self.feats_self_attn.among(features, points, *_neighbours(points, points))
        moved = []
        layers = zip(self.query_self_attn, self.query_feats_cross_attn, branches, strict=True)
        for among, across, branch in layers:
            embeddings = among.among(embeddings, queries, *_neighbours(queries, queries))
            embeddings = across.across(embeddings, queries, features, *_neighbours(queries, points))
            queries = torch.sigmoid(branch(embeddings) + inverse_sigmoid(queries))
            moved.append(queries)
        return moved


def _neighbours(queries: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return numbers (sample, query, k) and coordinates (sample, query, k, 3) of the nearest points."""
    index = nearest(queries, points, _NUM_NEIGHBOURS)
    return index, rows_of(points, index)
