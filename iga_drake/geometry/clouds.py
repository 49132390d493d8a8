"""Point clouds: samples and frames (PyTorch, batched), voxels and stray points (NumPy)."""

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

# Medians of the distance to the two nearest neighbours: the reach of a point, and that in clouds of
# which more than a hundredth lies beyond it.
REACH = 4.5
REACH_AMONG_STRAYS = 3.0
CLUMP = 4  # points that belong to an object although they lie out of reach of the others


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


def own_frames(points: Tensor) -> Tensor:
    """Rotations (B, 3, 3) whose columns are axes that turn with points (B, M, 3) about their
    centroid: the first towards the point furthest from it, the second towards the one furthest
    aside."""
    far = points.square().sum(-1).argmax(-1)[:, None, None]
    first = torch.nn.functional.normalize(points.take_along_dim(far, 1)[:, 0], dim=-1)
    aside = points - (points @ first[..., None]) * first[:, None]
    far = aside.square().sum(-1).argmax(-1)[:, None, None]
    second = aside.take_along_dim(far, 1)[:, 0]
    # Points on one line leave the second axis open.
    straight = second.norm(dim=-1, keepdim=True) < 1e-9
    spare = torch.eye(3).to(first)[first.abs().argmin(-1)]
    spare = spare - (spare * first).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(torch.where(straight, spare, second), dim=-1)
    return torch.stack((first, second, torch.linalg.cross(first, second, dim=-1)), -1)


def voxel_indices(points: np.ndarray, size: float) -> np.ndarray:
    """Indices (M,) of one point per occupied voxel: the first in order. points (P, 3), metres."""
    cells = np.floor(points / size).astype(np.int64)
    cells -= cells.min(0)
    span = cells.max(0) + 1
    keys = (cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2]
    return np.unique(keys, return_index=True)[1]


def stray_points(points: np.ndarray) -> np.ndarray:
    """Which points (P,) of a cloud (P, 3) are strays: bool.

    A point is a stray where its two nearest neighbours are, in the mean, more than `REACH` medians
    of that distance away. Where over a hundredth of the points are, the cloud is known to have
    strays, and they are looked for more closely: the reach is `REACH_AMONG_STRAYS`, and a clump of
    fewer than `CLUMP` points (fewer in clouds of under 200) that is out of reach of all others is
    stray as well. So thin parts stay, although their points have few neighbours, and so do parts
    that were seen apart. Repeated points count once. A cloud of which less than half would be left
    has no strays.
    """
    strays = _stray_points(points)
    if strays is not None:
        return strays
    distinct, inverse = np.unique(points, axis=0, return_inverse=True)
    strays = _stray_points(distinct)
    assert strays is not None
    return strays[inverse.ravel()]


def _stray_points(points: np.ndarray) -> np.ndarray | None:
    """`stray_points` of distinct points; None where some are repeated."""
    P = len(points)
    none = np.zeros(P, dtype=bool)
    if P < 16:
        return none
    distance, neighbour = (each[:, 1:] for each in cKDTree(points).query(points, k=4))
    if (distance[:, 0] == 0).any():
        return None
    nearest = distance[:, :2].mean(1)
    median = np.median(nearest)
    strays = nearest > REACH * median
    if strays.mean() <= 0.01:
        return strays
    reach = REACH_AMONG_STRAYS * median
    near = (distance <= reach) & (nearest <= reach)[:, None]
    of = np.nonzero(near)
    links = coo_array((np.ones(len(of[0])), (of[0], neighbour[of])), shape=(P, P))
    _, label = connected_components(links, directed=False)
    clump = np.bincount(label)[label]
    strays = (nearest > reach) | (clump < min(CLUMP, P // 50))
    return strays if 2 * strays.sum() < P else none
