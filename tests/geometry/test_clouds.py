"""Sampling of clouds against brute force."""

import numpy as np
import pytest
import torch

from iga_drake.geometry.clouds import furthest_point_sampling, voxel_indices


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


def test_voxel_indices_keep_one_point_per_voxel() -> None:
    points = np.random.default_rng(1).normal(size=(2000, 3)) * 0.05
    kept = points[voxel_indices(points, 0.01)]
    cells = np.floor(kept / 0.01).astype(int)
    assert len(np.unique(cells, axis=0)) == len(kept)
    assert len(kept) == len(np.unique(np.floor(points / 0.01).astype(int), axis=0))
