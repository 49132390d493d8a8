import numpy as np
import open3d
import pytest
from pydrake.perception import PointCloud
from scipy.ndimage import label

from iga_drake.geometry.voxels import VoxelError, voxel_cloud, voxelize

SIZE = 0.005


def _cloud(seed: int, count: int = 20_000) -> np.ndarray:
    """A noisy sphere and a plane, and specks, away from the voxels' borders."""
    rng = np.random.default_rng(seed)
    sphere = rng.standard_normal((count, 3))
    sphere *= 0.06 / np.linalg.norm(sphere, axis=1, keepdims=True)
    plane = np.c_[rng.uniform(-0.2, 0.2, (count, 2)), rng.normal(0, 0.002, count)]
    specks = rng.uniform(-0.2, 0.2, (40, 3))
    points = np.concatenate([sphere, plane, specks]).astype(np.float32)
    phase = points / SIZE - np.floor(points / SIZE)
    return points[((phase > 0.01) & (phase < 0.99)).all(axis=1)]


def _sorted(points: np.ndarray) -> np.ndarray:
    cells = np.floor(points / SIZE).astype(int)
    return points[np.lexsort(cells.T)]


@pytest.mark.parametrize("seed", range(3))
def test_same_voxels_and_centroids_as_open3d(seed):
    # Open3D's grid starts half a voxel below the least coordinates: an anchor puts it on ours.
    points = np.concatenate([_cloud(seed), np.full((1, 3), -60.5 * SIZE, np.float32)])
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(float)))
    theirs = np.asarray(cloud.voxel_down_sample(SIZE).points)
    ours = voxel_cloud(points, SIZE)
    assert len(ours) == len(theirs)
    np.testing.assert_allclose(_sorted(ours), _sorted(theirs), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_same_voxels_and_centroids_as_drake(seed):
    # Drake's grid starts at the least coordinates.
    points = np.concatenate([_cloud(seed), np.full((1, 3), -60 * SIZE, np.float32)])
    cloud = PointCloud(len(points))
    cloud.mutable_xyzs()[:] = points.T
    theirs = cloud.VoxelizedDownSample(SIZE).xyzs().T
    ours = voxel_cloud(points + np.float32(1e-7), SIZE)
    assert len(ours) == len(theirs)
    np.testing.assert_allclose(_sorted(ours), _sorted(theirs + 1e-7), atol=2e-6)


def test_counts_and_centroids_by_hand():
    points = np.array([[0.001, 0.001, 0.001], [0.003, 0.001, 0.001], [-0.001, 0.001, 0.001]])
    grid = voxelize(points, SIZE)
    assert sorted(grid.counts) == [1, 2]
    np.testing.assert_allclose(
        _sorted(grid.centroids), [[-0.001, 0.001, 0.001], [0.002, 0.001, 0.001]], atol=1e-8
    )


def test_memory_layout_does_not_matter():
    points = _cloud(0)
    np.testing.assert_array_equal(
        voxel_cloud(points, SIZE), voxel_cloud(np.asfortranarray(points), SIZE)
    )


@pytest.mark.parametrize("size", [2, 4, 8, 20, 40])
@pytest.mark.parametrize("density", [0.02, 0.06])
def test_specks_are_the_small_components(size, density):
    """Against scipy's labelling of the dense grid."""
    dense = np.random.default_rng(size).random((24, 20, 22)) < density
    dense[3:8, 3:8, 5] = True
    points = (np.argwhere(dense) + 0.5) * SIZE
    labels, _ = label(dense, structure=np.ones((3, 3, 3)))
    small = np.bincount(labels.ravel())[labels[dense]] < size
    kept = voxel_cloud(points, SIZE, min_cluster=size)
    np.testing.assert_allclose(_sorted(kept), _sorted(points[~small]), atol=1e-6)
    grid = voxelize(points, SIZE)
    assert grid.specks(size).sum() == small.sum()


def test_isolated_points_go_and_the_object_stays():
    rng = np.random.default_rng(0)
    plane = np.c_[rng.uniform(0, 0.1, (5000, 2)), np.zeros(5000)]
    outliers = rng.uniform(0.3, 0.9, (10, 3))
    cloud = voxel_cloud(np.concatenate([plane, outliers]), SIZE, min_cluster=8)
    assert cloud.max() < 0.11
    assert len(cloud) == len(voxel_cloud(plane, SIZE))


def test_empty_and_single():
    assert voxel_cloud(np.zeros((0, 3)), SIZE, 8).shape == (0, 3)
    assert voxel_cloud(np.zeros((1, 3)), SIZE).shape == (1, 3)
    assert voxel_cloud(np.zeros((1, 3)), SIZE, 2).shape == (0, 3)


def test_a_cloud_that_is_far_too_large_is_refused():
    with pytest.raises(VoxelError, match="crop"):
        voxelize(np.array([[0.0, 0.0, 0.0], [100.0, 100.0, 100.0]]), SIZE)
