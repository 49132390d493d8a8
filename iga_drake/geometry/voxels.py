"""A voxel filter for clouds of up to a few million points, and the removal of specks."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from iga_drake.errors import IgaDrakeError

# The grid's look-up tables have one entry for each cell of the cloud's bounding box.
_MOST_CELLS = 200_000_000


class VoxelError(IgaDrakeError):
    """A cloud can't be put into voxels."""


@dataclass(frozen=True)
class VoxelGrid:
    """The occupied voxels of a cloud: cubes with edges at whole multiples of the voxel size."""

    centroids: np.ndarray  # (K, 3) float32, mean of each voxel's points (m)
    counts: np.ndarray  # (K,) points in each voxel
    cells: np.ndarray  # (K,) index of each voxel in the tables
    occupied: np.ndarray  # (cells of the padded bounding box,) bool
    row_of_cell: np.ndarray  # (same,) int32: row in the arrays above; noise where not occupied
    steps: np.ndarray  # (26,) difference of `cells` between a voxel and its neighbours

    def specks(self, size: int) -> np.ndarray:
        """Voxels in connected groups (26 neighbours) of fewer than `size` voxels: (K,) bool."""
        neighbours = np.zeros(len(self.cells), dtype=np.int8)
        for step in self.steps:
            neighbours += self.occupied[self.cells + step]
        # One with so many neighbours that they alone make up a group needs no further look, nor
        # does its group: among the few others a flag "touches such a one" decides.
        thin = np.flatnonzero(neighbours < size - 1)
        thin_of_row = np.full(len(self.cells), -1, dtype=np.int32)
        thin_of_row[thin] = np.arange(len(thin))
        kept = np.zeros(len(thin), dtype=bool)
        pairs = []
        for step in self.steps:
            cells = self.cells[thin] + step
            i = np.flatnonzero(self.occupied[cells])
            j = thin_of_row[self.row_of_cell[cells[i]]]
            kept[i[j < 0]] = True
            pairs.append(np.stack([i[j >= 0], j[j >= 0]]))
        i, j = np.concatenate(pairs, axis=1)
        graph = coo_matrix((np.ones(len(i), dtype=bool), (i, j)), shape=(len(thin), len(thin)))
        count, group = connected_components(graph, directed=False)
        good = np.bincount(group, minlength=count) >= size
        good[group[kept]] = True
        result = np.zeros(len(self.cells), dtype=bool)
        result[thin[~good[group]]] = True
        return result


def voxelize(points: np.ndarray, voxel_size: float) -> VoxelGrid:
    """Groups finite `points` (P, 3) in metres by voxel; at least one point.

    Voxels are aligned with the frame's origin, so that clouds of one frame share a grid. Fastest
    if the coordinates are contiguous (the transpose of a (3, P) array).
    Raises `VoxelError` if the bounding box holds too many voxels for a table (crop the cloud).
    """
    xyz = np.ascontiguousarray(np.asarray(points, dtype=np.float32).T)  # (3, P)
    inverse = np.float32(1.0 / voxel_size)
    # One empty layer around the bounding box: a neighbour is never outside of the tables.
    lower = np.floor(xyz.min(axis=1) * inverse) - 1
    shape = np.floor(xyz.max(axis=1) * inverse) + 1 - lower + 1
    if not np.prod(shape.astype(float)) <= _MOST_CELLS:
        raise VoxelError(
            f"a cloud of {shape[0]:g} x {shape[1]:g} x {shape[2]:g} voxels of {voxel_size} m: "
            "crop it to the work area or take larger voxels"
        )
    shape = shape.astype(np.int64)
    strides = (int(shape[1] * shape[2]), int(shape[2]), 1)
    keys = np.zeros(xyz.shape[1], dtype=np.int32)
    for axis, stride in enumerate(strides):
        cell = np.floor(xyz[axis] * inverse)
        cell -= lower[axis]
        keys += cell.astype(np.int32) * np.int32(stride)
    occupied = np.zeros(int(np.prod(shape)), dtype=bool)
    occupied[keys] = True
    cells = np.flatnonzero(occupied)
    row_of_cell = np.empty(len(occupied), dtype=np.int32)
    row_of_cell[cells] = np.arange(len(cells), dtype=np.int32)
    rows = row_of_cell[keys]
    counts = np.bincount(rows)
    centroids = np.empty((len(cells), 3), dtype=np.float32)
    for axis in range(3):
        centroids[:, axis] = np.bincount(rows, weights=xyz[axis]) / counts
    steps = np.array([s for s in product((-1, 0, 1), repeat=3) if any(s)]) @ np.array(strides)
    return VoxelGrid(centroids, counts, cells, occupied, row_of_cell, steps)


def voxel_cloud(points: np.ndarray, voxel_size: float, min_cluster: int = 1) -> np.ndarray:
    """Thins `points` (P, 3) to one point, the centroid, for each voxel: (K, 3) float32.

    Connected groups of fewer than `min_cluster` voxels are specks and left out.
    """
    if len(points) == 0:
        return np.zeros((0, 3), dtype=np.float32)
    grid = voxelize(points, voxel_size)
    return grid.centroids if min_cluster <= 1 else grid.centroids[~grid.specks(min_cluster)]
