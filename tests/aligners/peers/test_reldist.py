"""RelDist-DC: multilateration against exact distances."""

import pytest
import torch

from iga_drake.aligners.peers.reldist import multilaterate


@pytest.mark.parametrize("seed", range(4))
def test_exact_distances_give_the_points_back(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    anchors = 0.1 * torch.randn(2, 12, 3, generator=generator, dtype=torch.float64)
    points = 0.1 * torch.randn(2, 7, 3, generator=generator, dtype=torch.float64) + 0.1
    weight = torch.rand(2, 7, 12, generator=generator, dtype=torch.float64) + 0.1
    distance = torch.cdist(points, anchors)
    torch.testing.assert_close(
        multilaterate(anchors, distance, weight, iterations=20), points, atol=1e-5, rtol=0
    )


def test_a_wrong_distance_without_weight_does_no_harm() -> None:
    generator = torch.Generator().manual_seed(0)
    anchors = 0.1 * torch.randn(1, 12, 3, generator=generator, dtype=torch.float64)
    points = 0.1 * torch.randn(1, 5, 3, generator=generator, dtype=torch.float64)
    distance, weight = torch.cdist(points, anchors), torch.ones(1, 5, 12, dtype=torch.float64)
    distance[..., 3] += 0.2
    weight[..., 3] = 0
    found = multilaterate(anchors, distance, weight, iterations=20)
    torch.testing.assert_close(found, points, atol=1e-5, rtol=0)
