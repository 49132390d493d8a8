"""Point clouds: furthest point sampling (PyTorch, batched) and voxel grids (NumPy)."""

import numpy as np
import torch
from torch import Tensor


def furthest_point_sampling(points: Tensor, count: int, start: Tensor | None = None) -> Tensor:
    """Indices (B, count) of furthest point samples of points (B, P, 3) (Eldar et al. 1997).

    Deterministic: starts at the point furthest from the centroid unless `start` (B,) is given.
    Duplicated points (padding) are only chosen when nothing else is left.
    """
    B, P, _ = points.shape
    if count > P:
        raise ValueError(f"furthest_point_sampling: {count} samples asked of {P} points")
    if start is None:
        start = (points - points.mean(1, keepdim=True)).square().sum(-1).argmax(1)
    chosen = torch.empty(B, count, dtype=torch.long, device=points.device)
    rows = torch.arange(B, device=points.device)
    distance = torch.full((B, P), torch.inf, dtype=points.dtype, device=points.device)
    index = start
    x = points.mT.contiguous()  # (B, 3, P)
    for k in range(count):
        chosen[:, k] = index
        gap = x - x[rows, :, index, None]
        distance = torch.minimum(distance, gap.square_().sum(1))
        index = distance.argmax(1)
    return chosen


def voxel_indices(points: np.ndarray, size: float) -> np.ndarray:
    """Indices (M,) of one point per occupied voxel: the first in order. points (P, 3), metres."""
    cells = np.floor(points / size).astype(np.int64)
    cells -= cells.min(0)
    span = cells.max(0) + 1
    keys = (cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2]
    return np.unique(keys, return_index=True)[1]
