"""RelDist-DC: multilateration against exact distances; the pose moves with the clouds."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from iga_drake.aligners.peers.reldist import (
    RelDistAligner,
    RelDistConfig,
    RelDistNet,
    RelDistSearch,
    multilaterate,
)
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.training.reldist import RelDistTraining, reldist_loss

TINY = RelDistConfig(scalars=24, vectors=4, heads=2, layers=2, descriptor=24, hidden=16)


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


def _motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    X = np.eye(4)
    X[:3, :3] = Rotation.random(rng=rng).as_matrix()
    X[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    return X


def _moved(X: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    return cloud @ X[:3, :3].T + X[:3, 3]


def test_the_pose_moves_with_either_cloud() -> None:
    """Untrained: whatever it says, it says of the objects and not of their frames."""
    torch.manual_seed(0)
    net = RelDistNet(TINY)
    torch.nn.init.normal_(net.kernel[-1].weight, std=0.3)
    aligner = RelDistAligner(net)
    points = make_sample("validation", 3).points.astype(float)
    context = tuple(Alignment(points[0, n], points[1, n]) for n in range(2))
    before = aligner.align(context, points[0, -1], points[1, -1])
    F, W = _motion(1), _motion(2)
    G = [_motion(3 + n) for n in range(2)]
    turned = tuple(
        Alignment(_moved(X, a.grasped), _moved(X, a.target))
        for X, a in zip(G, context, strict=True)
    )
    after = aligner.align(turned, _moved(F, points[0, -1]), _moved(W, points[1, -1]))
    np.testing.assert_allclose(after.poses[0], W @ before.poses[0] @ np.linalg.inv(F), atol=2e-3)
    np.testing.assert_allclose(after.energies, before.energies, rtol=1e-2)


@pytest.fixture(scope="module")
def learned() -> tuple[RelDistAligner, np.ndarray]:
    """Trained on one pair of clouds alone, and these (2, P, 3)."""
    sample = make_sample("validation", 1, SampleConfig(cloud_points=96))
    fields = ("points", "canonical", "present")
    # Shown once, then asked.
    same = {name: np.repeat(getattr(sample, name)[:, -1:], 2, 1) for name in fields}
    batch = {name: torch.from_numpy(value)[None] for name, value in same.items()}
    torch.manual_seed(0)
    config = RelDistTraining(nodes=24, match_sigma=0.02)
    net, generator = RelDistNet(TINY), torch.Generator().manual_seed(0)
    steps = 120
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.02, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        reldist_loss(net, batch, config, generator).total.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return RelDistAligner(net, config=RelDistSearch(nodes=24)), same["points"][:, 0].astype(float)


@pytest.mark.parametrize("seed", range(3))
def test_the_same_objects_in_new_poses_are_put_back(learned, seed: int) -> None:
    aligner, (A, B) = learned
    F, W = _motion(seed), _motion(10 + seed)
    estimate = aligner.align((Alignment(A, B),), _moved(F, A), _moved(W, B))
    off = np.linalg.inv(W) @ estimate.poses[0] @ F
    centre = A.mean(0)
    assert np.linalg.norm(_moved(off, centre) - centre) < 0.005
    assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 3
