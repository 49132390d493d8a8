"""TAX-Pose-DC: learns one pair of objects, and puts it back from any pose."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from iga_drake.aligners.peers.taxpose import EdgeLayer, TaxPoseAligner, TaxPoseConfig, TaxPoseNet
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.training.taxpose import TaxPoseTraining, taxpose_loss

TINY = TaxPoseConfig(width=32, heads=2, blocks=1, edge_layers=2, neighbours=8, points=48)


def _motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    X = np.eye(4)
    X[:3, :3] = Rotation.random(rng=rng).as_matrix()
    X[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    return X


def _moved(X: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    return cloud @ X[:3, :3].T + X[:3, 3]


def test_an_edge_layer_is_the_largest_over_the_nearest_points() -> None:
    torch.manual_seed(0)
    layer, x = EdgeLayer(3, 5, 4), torch.randn(1, 9, 3)
    out = layer(x)
    gap = x[0] - x[0, 2]
    near = gap.norm(dim=-1).argsort()[:4]
    each = gap[near] @ layer.difference.weight.T + layer.own(x[0, 2])
    expected = torch.nn.functional.leaky_relu(layer.norm(each.amax(0)), 0.2)
    torch.testing.assert_close(out[0, 2], expected, atol=1e-5, rtol=1e-5)


@pytest.fixture(scope="module")
def learned() -> tuple[TaxPoseAligner, np.ndarray]:
    """Trained on one pair of clouds alone, and these (2, P, 3)."""
    sample = make_sample("validation", 1, SampleConfig(cloud_points=96))
    fields = ("points", "canonical", "present")
    # Shown once, then asked.
    same = {name: np.repeat(getattr(sample, name)[:, -1:], 2, 1) for name in fields}
    batch = {name: torch.from_numpy(value)[None] for name, value in same.items()}
    torch.manual_seed(0)
    net, generator = TaxPoseNet(TINY), torch.Generator().manual_seed(0)
    steps = 150
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.02, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        taxpose_loss(net, batch, TaxPoseTraining(), generator).total.backward()
        optimizer.step()
        schedule.step()
    return TaxPoseAligner(net), same["points"][:, 0].astype(float)


@pytest.mark.parametrize("seed", range(3))
def test_the_same_objects_in_new_poses_are_put_back(learned, seed: int) -> None:
    aligner, (A, B) = learned
    F, W = _motion(seed), _motion(10 + seed)
    estimate = aligner.align((Alignment(A, B),), _moved(F, A), _moved(W, B))
    off = np.linalg.inv(W) @ estimate.poses[0] @ F
    centre = A.mean(0)
    assert np.linalg.norm(_moved(off, centre) - centre) < 0.005
    assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 3
