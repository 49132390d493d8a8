"""A voxel filter for clouds of up to a few million points, and the removal of specks."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from iga_drake.errors import IgaDrakeError

# The grid's look-up table has one entry for each cell of the cloud's bounding box.
_MOST_CELLS = 200_000_000


class VoxelError(IgaDrakeError):
    """A cloud can't be put into voxels."""


@dataclass(frozen=True)
class VoxelGrid:
    """The occupied voxels of a cloud: cubes with edges at whole multiples of `voxel_size`."""

    voxel_size: float  # m
    centroids: np.ndarray  # (K, 3) float32, mean of each voxel's points (m)
    counts: np.ndarray  # (K,) points in each voxel
    cells: np.ndarray  # (K,) index into the table
    table: np.ndarray  # flat (cells of the padded bounding box,) int32: row of the voxel or -1
    strides: tuple[int, int, int]  # of `table`

    def components(self) -> np.ndarray:
        """Numbers (K,) of the connected groups of voxels that touch (26 neighbours)."""
        sx, sy, sz = self.strides
        steps = [
            x * sx + y * sy + z * sz
            for x in (-1, 0, 1)
            for y in (-1, 0, 1)
            for z in (-1, 0, 1)
            if (x, y, z) > (0, 0, 0)
        ]
        rows, columns = [], []
        for step in steps:
            neighbour = self.table[self.cells + step]
            found = np.flatnonzero(neighbour >= 0)
            rows.append(found)
            columns.append(neighbour[found])
        i, j = np.concatenate(rows), np.concatenate(columns)
        size = len(self.cells)
        graph = coo_matrix((np.ones(len(i), dtype=np.int8), (i, j)), shape=(size, size))
        return connected_components(graph, directed=False)[1]


def voxelize(points: np.ndarray, voxel_size: float) -> VoxelGrid:
    """Groups finite `points` (P, 3) in metres by voxel.

    Voxels are aligned with the frame's origin, so that clouds of one frame share a grid.
    Raises `VoxelError` if the bounding box holds too many voxels for a table (crop the cloud).
    """
    points = np.ascontiguousarray(points, dtype=np.float32)
    if len(points) == 0:
        empty = np.zeros(0, dtype=np.int64)
        return VoxelGrid(
            voxel_size, np.zeros((0, 3), np.float32), empty, empty, np.zeros(0, np.int32), (0, 0, 0)
        )
    inverse = 1.0 / voxel_size
    # One empty layer around the bounding box: a neighbour is never outside of the table.
    lower = np.floor(points.min(axis=0) * inverse).astype(np.int64) - 1
    upper = np.floor(points.max(axis=0) * inverse).astype(np.int64) + 1
    shape = upper - lower + 1
    if np.prod(shape.astype(float)) > _MOST_CELLS:
        raise VoxelError(
            f"a cloud of {shape[0]} x {shape[1]} x {shape[2]} voxels of {voxel_size} m: crop it to "
            "the work area or take larger voxels"
        )
    strides = (int(shape[1] * shape[2]), int(shape[2]), 1)
    keys = np.zeros(len(points), dtype=np.int32)
    for axis, stride in enumerate(strides):
        # In float32 a coordinate below 1 m is exact to 6e-8 m. floor = truncation from here on.
        cell = points[:, axis] * np.float32(inverse) - np.float32(lower[axis])
        keys += cell.astype(np.int32) * np.int32(stride)
    table = np.full(int(np.prod(shape)), -1, dtype=np.int32)
    table[keys] = 0
    cells = np.flatnonzero(table == 0)
    table[cells] = np.arange(len(cells), dtype=np.int32)
    rows = table[keys]
    counts = np.bincount(rows)
    centroids = np.empty((len(cells), 3), dtype=np.float32)
    for axis in range(3):
        centroids[:, axis] = np.bincount(rows, weights=points[:, axis]) / counts
    return VoxelGrid(voxel_size, centroids, counts, cells, table, strides)


def voxel_cloud(points: np.ndarray, voxel_size: float, min_cluster: int = 1) -> np.ndarray:
    """Thins `points` (P, 3) to one point, the centroid, for each voxel: (K, 3) float32.

    Connected groups of fewer than `min_cluster` voxels are specks and left out.
    """
    grid = voxelize(points, voxel_size)
    if min_cluster <= 1 or len(grid.cells) == 0:
        return grid.centroids
    group = grid.components()
    return grid.centroids[np.bincount(group)[group] >= min_cluster]
