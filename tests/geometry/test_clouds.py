"""Sampling of clouds against brute force."""

import numpy as np
import pytest
import torch

from iga_drake.dataset.samples import make_sample
from iga_drake.geometry.clouds import furthest_point_sampling, stray_points, voxel_indices


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


def _plate(rng: np.random.Generator, count: int = 600) -> np.ndarray:
    """A plate of 12 by 12 cm, its points about 5 mm apart."""
    side = np.arange(25) * 0.005
    grid = np.stack(np.meshgrid(side, side, [0.0]), -1).reshape(-1, 3)
    return (grid + rng.normal(size=grid.shape) * 0.0007)[rng.permutation(len(grid))[:count]]


def test_points_far_from_all_others_are_strays_and_the_objects_own_are_not() -> None:
    rng = np.random.default_rng(0)
    plate = _plate(rng)
    strays = rng.uniform([-0.05, -0.05, 0.03], [0.17, 0.17, 0.2], (30, 3))
    found = stray_points(np.concatenate((plate, strays)))
    assert found[len(plate) :].mean() > 0.9
    assert found[: len(plate)].mean() < 0.01


def test_thin_sparse_and_detached_parts_are_no_strays() -> None:
    """Rods of few points, in reach of the plate and out of it, and a plate thrice as sparse."""
    rng = np.random.default_rng(1)
    plate = _plate(rng)
    rod = np.zeros((9, 3))
    rod[:, 0] = 0.12 + 0.008 * np.arange(1, 10)  # 8 mm apart, the plate's points 5 mm
    apart = np.array([0.0, 0.0, 0.06]) + 0.005 * rng.uniform(size=(6, 3)) * [6, 1, 1]
    sparse = _plate(rng, 100) + [0.0, 0.14, 0.0]
    cloud = np.concatenate((plate, rod, apart, sparse))
    found = stray_points(cloud)
    parts = np.split(found, np.cumsum([len(plate), len(rod), len(apart)]))
    assert not parts[1].any() and not parts[2].any()
    assert parts[3].mean() < 0.1


def test_strays_do_not_depend_on_frame_order_or_repetition() -> None:
    rng = np.random.default_rng(2)
    cloud = np.concatenate((_plate(rng, 200), rng.uniform(-0.1, 0.2, (10, 3))))
    plain = stray_points(cloud)
    assert 0 < plain.sum() <= 12
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    order = rng.permutation(len(cloud))
    np.testing.assert_array_equal(stray_points((cloud @ R.T + 1)[order]), plain[order])
    np.testing.assert_array_equal(stray_points(np.tile(cloud, (3, 1))), np.tile(plain, 3))


@pytest.mark.parametrize("split", ["unseen_categories", "validation"])
def test_clean_clouds_lose_less_than_one_percent(split: str) -> None:
    lost = []
    for index in range(6):
        for cloud in make_sample(split, index).points.astype(float).reshape(-1, 256, 3):
            lost.append(stray_points(cloud).mean())
    assert np.mean(lost) < 0.01 and max(lost) < 0.08


def test_a_cloud_of_scattered_points_is_left_alone() -> None:
    rng = np.random.default_rng(3)
    assert not stray_points(np.exp(2 * rng.normal(size=(40, 3)))).all()
    assert not stray_points(rng.normal(size=(10, 3))).any()
