"""Sampling of clouds against brute force and Open3D."""

import numpy as np
import open3d
import pytest
import torch

from iga_drake.geometry.clouds import furthest_point_sampling, voxel_downsample, voxel_indices


def test_furthest_point_sampling_is_greedy_and_distinct() -> None:
    points = torch.randn(3, 80, 3, generator=torch.Generator().manual_seed(0))
    index = furthest_point_sampling(points, 20)
    for cloud, chosen in zip(points, index, strict=True):
        assert len(set(chosen.tolist())) == 20
        for k in range(1, 20):
            gap = torch.cdist(cloud, cloud[chosen[:k]]).amin(1)
            assert gap[chosen[k]] == pytest.approx(float(gap.max()), rel=1e-5)


def test_furthest_point_sampling_moves_with_the_cloud() -> None:
    points = torch.randn(1, 60, 3, dtype=torch.float64)
    R = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    same = furthest_point_sampling(points @ R.T + 1.0, 15)
    assert torch.equal(same, furthest_point_sampling(points, 15))


def test_too_many_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="9 samples asked of 5 points"):
        furthest_point_sampling(torch.zeros(1, 5, 3), 9)


def test_voxel_downsample_matches_open3d() -> None:
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (5000, 3))
    # Open3D's grid starts half a voxel below the minimum: give it the same origin by a corner
    # point.
    corner = np.floor(points.min(0) / 0.01) * 0.01 + 0.005
    points = np.concatenate((points, corner[None]))
    points = points[(points >= corner - 1e-12).all(1)]
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    expected = np.asarray(cloud.voxel_down_sample(0.01).points)
    ours = voxel_downsample(points, 0.01)
    assert ours.shape == expected.shape
    np.testing.assert_allclose(
        ours[np.lexsort(ours.round(9).T)], expected[np.lexsort(expected.round(9).T)], atol=1e-9
    )


def test_voxel_indices_keep_one_point_per_voxel() -> None:
    points = np.random.default_rng(1).normal(size=(2000, 3)) * 0.05
    kept = points[voxel_indices(points, 0.01)]
    cells = np.floor(kept / 0.01).astype(int)
    assert len(np.unique(cells, axis=0)) == len(kept)
    assert len(kept) == len(np.unique(np.floor(points / 0.01).astype(int), axis=0))


def test_empty_cloud_stays_empty() -> None:
    assert voxel_downsample(np.zeros((0, 3)), 0.01).shape == (0, 3)
