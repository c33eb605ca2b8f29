"""What the released v1 and v2 share: convolutions, key points, triangulation, projection, vector attention.

Letters of shapes: c = channels, h and w = cells of a map, k = neighbours.
"""

from collections.abc import Mapping

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
import torch.nn.functional as F  # pyright: ignore[reportMissingImports]
from torch import Tensor, nn  # pyright: ignore[reportMissingImports]

IMAGE_SIZE = 256
"""Pixels of a side of the square images."""
WRIST, ROOT_JOINT = 0, 9
NUM_JOINTS, NUM_VERTICES = 21, 778
NUM_QUERIES = NUM_JOINTS + NUM_VERTICES
"""Query points: the joints, then the vertices."""
_MIN_DEPTH = 1e-7
_SUM_EPSILON, _HOMOGENEOUS_EPSILON, _COUNT_EPSILON = 1e-6, 1e-7, 1e-6
_TEMPERATURE = 10000


def load_released(model: nn.Module, state: Mapping[str, np.ndarray]) -> None:
    """Load a released state dict; arrays that the model does not have are those that nothing depends on."""
    model.load_state_dict({name: torch.from_numpy(np.asarray(state[name])) for name in model.state_dict()})


def as_images(views: np.ndarray, memory_format: torch.memory_format) -> Tensor:
    """Turn uint8 images (view, h, w, 3) into (view, 3, h, w), -0.5 to 0.5, laid out as asked."""
    images = torch.from_numpy(views).permute(0, 3, 1, 2).float() / 255 - 0.5
    return images.contiguous(memory_format=memory_format)


class ConvBlock(nn.Module):
    """Convolution with a bias, then batch norm and ReLU unless `plain`."""

    def __init__(self, c_in: int, c_out: int, size: int, stride: int = 1, *, plain: bool = False) -> None:
        super().__init__()
        self.conv = nn.Conv2d(c_in, c_out, size, stride, size // 2)
        self.norm = None if plain else nn.BatchNorm2d(c_out)

    def forward(self, x: Tensor) -> Tensor:
        """Map (image, c_in, h, w) to (image, c_out, h / stride, w / stride)."""
        x = self.conv(x)
        return x if self.norm is None else F.relu(self.norm(x), inplace=True)


def two_layers(c_in: int, hidden: int, c_out: int) -> nn.Sequential:
    """Return two linear layers with a ReLU between them, of the last axis."""
    return nn.Sequential(nn.Linear(c_in, hidden), nn.ReLU(), nn.Linear(hidden, c_out))


def doubled(maps: Tensor) -> Tensor:
    """Enlarge (image, c, h, w) to (image, c, 2 h, 2 w), bilinearly."""
    return F.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)


def top_down(levels: list[Tensor], blocks: nn.ModuleList) -> Tensor:
    """Go from the coarsest map to the finest: enlarge, append the finer map, convolve.

    `levels`: (image, c, h, w), finest first. Returns a map of the finest's size.
    """
    x = levels[-1]
    for block, finer in zip(blocks, levels[-2::-1], strict=True):
        x = block(torch.cat([doubled(x), finer], 1))
    return x


# First stage.


def expected_pixels(logits: Tensor) -> Tensor:
    """Return the expectation of each heat map in pixels: (image, joint, h, w) to (image, joint, 2).

    Cell i stands for pixel i times the stride, without half a cell.
    """
    heat = torch.sigmoid(logits)
    share = heat / (heat.sum((-2, -1), keepdim=True) + _SUM_EPSILON)
    h, w = logits.shape[-2:]
    u = (share.sum(-2) * torch.arange(w) / w).sum(-1)
    v = (share.sum(-1) * torch.arange(h) / h).sum(-1)
    return torch.stack([u, v], -1) * IMAGE_SIZE


def triangulate(uv_px: Tensor, K: Tensor, E: Tensor) -> Tensor:
    """Return the joints of one sample (joint, 3) in its master camera's frame.

    Unweighted DLT, rows not scaled. `uv_px` (view, joint, 2), `K` (view, 3, 3), `E` (view, 4, 4): camera to
    master.
    """
    M = K @ torch.linalg.inv(E)[:, :3]
    rows = uv_px[..., None] * M[:, None, 2:] - M[:, None, :2]
    A = rows.transpose(0, 1).flatten(1, 2)
    X = torch.linalg.svd(A, full_matrices=False).Vh[:, -1]
    return X[:, :3] / (X[:, 3:] + _HOMOGENEOUS_EPSILON)


# Reading maps at points.


def projected(points: Tensor, K: Tensor, E: Tensor) -> Tensor:
    """Project points into every view, as `sampled` wants them: (view, point, 2), -1 to 1 over the image.

    `points` (view or 1, point, 3) in the master's frame, `K` (view, 3, 3), `E` (view, 4, 4): camera to
    master. Points behind a camera are projected, too.
    """
    T = torch.linalg.inv(E)
    in_camera = points @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
    uvw = in_camera @ K.transpose(1, 2)
    depth = uvw[..., 2:]
    depth = torch.where(depth.abs() < _MIN_DEPTH, _MIN_DEPTH, depth)
    return uvw[..., :2] / depth / IMAGE_SIZE * 2 - 1


def sampled(maps: Tensor, places: Tensor) -> Tensor:
    """Sample (view, c, h, w) at (view, point, 2) bilinearly, zeros outside: (view, c, point)."""
    return F.grid_sample(maps, places[:, :, None], align_corners=False)[..., 0]


def view_row_column_code(views: int, h: int, w: int, width: int) -> Tensor:
    """Encode number of the view, row and column, `width` numbers each: (view, 3 width, h, w).

    Numbers count from 1 and are shares of a turn; sines come first, then cosines.
    """
    j = torch.arange(width)
    period = _TEMPERATURE ** (2 * torch.div(j, 2, rounding_mode="floor") / width)
    codes = []
    for axis, count in enumerate((views, h, w)):
        turn = torch.arange(1, count + 1) / (count + _COUNT_EPSILON) * (2 * torch.pi)
        angle = turn[:, None] / period
        code = torch.cat([angle[:, 0::2].sin(), angle[:, 1::2].cos()], 1)
        shape = [1, 1, 1, width]
        shape[axis] = count
        codes.append(code.reshape(shape).expand(views, h, w, width))
    return torch.cat(codes, -1).permute(0, 3, 1, 2).contiguous()


def similar_sum(theta: Tensor) -> Tensor:
    """Return the sum over the views j but the first of (theta_1 . theta_j) theta_j: (..., view, c) to
    (..., c)."""
    first, others = theta[..., :1, :], theta[..., 1:, :]
    return ((first * others).sum(-1, keepdim=True) * others).sum(-2)


# Vector attention.


def nearest(queries: Tensor, points: Tensor, k: int) -> Tensor:
    """Return the numbers of the k points nearest to each query: (batch, query, 3), (batch, point, 3) to
    (batch, query, k).

    Distances are of differences: those by a matrix product are too coarse in float32.
    """
    distance = torch.cdist(queries, points, compute_mode="donot_use_mm_for_euclid_dist")
    return distance.topk(k, largest=False).indices


def rows_of(table: Tensor, index: Tensor) -> Tensor:
    """Take rows of (batch, point, c) by (batch, query, k): (batch, query, k, c)."""
    return table[torch.arange(len(table))[:, None, None], index]


class VectorAttention(nn.Module):
    """Every query reads its neighbours with a weight per channel (Zhao et al. 2021)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, width), nn.Linear(width, width)
        self.fc_delta, self.fc_gamma = two_layers(3, width, width), two_layers(width, width, width)
        self.w_qs, self.w_ks, self.w_vs = (nn.Linear(width, width, bias=False) for _ in range(3))

    def among(self, features: Tensor, xyz: Tensor, index: Tensor, positions: Tensor) -> Tensor:
        """Let points read each other.

        Args:
            features: (batch, point, c).
            xyz: their coordinates (batch, point, 3).
            index: the neighbours of each (batch, point, k); an axis of 1 where all have the same.
            positions: coordinates of the neighbours (batch, point, k, 3), likewise.

        Returns: the features afterwards.
        """
        mapped = self.fc1(features)
        return self._read(features, mapped, mapped, xyz, index, positions)

    def across(
        self, features: Tensor, xyz: Tensor, source: Tensor, index: Tensor, positions: Tensor
    ) -> Tensor:
        """Let points read others, whose features are `source` (batch, other, c); `index` counts these."""
        return self._read(features, features, self.fc1(source), xyz, index, positions)

    def _read(
        self, residual: Tensor, queries: Tensor, source: Tensor, xyz: Tensor, index: Tensor, positions: Tensor
    ) -> Tensor:
        q, k, v = self.w_qs(queries), self.w_ks(source), self.w_vs(source)
        k, v = rows_of(k, index), rows_of(v, index)
        delta = self.fc_delta(xyz[:, :, None] - positions)
        logits = self.fc_gamma(q[:, :, None] - k + delta)
        weights = torch.softmax(logits / logits.shape[-1] ** 0.5, 2)
        return self.fc2(torch.einsum("bqkc,bqkc->bqc", weights, v + delta)) + residual
