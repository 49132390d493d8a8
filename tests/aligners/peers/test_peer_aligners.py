"""What all peers do: the pose moves with the clouds, and objects that are known are put back."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from iga_drake.aligners.peers.aligner import PeerAligner
from iga_drake.aligners.peers.reldist import RelDistConfig
from iga_drake.aligners.peers.rndf import RndfAligner
from iga_drake.aligners.peers.taxpose import TaxPoseConfig
from iga_drake.dataset.loader import collate
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.training import reldist, taxpose
from iga_drake.training.peers import Peer

# Training, sizes, what the aligner is made with, settings of the loss, steps and rate of learning.
TINY: dict[str, tuple[Peer, Any, dict, Any, int, float]] = {
    "reldist": (
        reldist.PEER,
        RelDistConfig(scalars=24, vectors=4, heads=2, layers=2, descriptor=24, hidden=16),
        {"nodes": 24},
        reldist.RelDistTraining(nodes=24, match_sigma=0.02),
        120,
        1e-2,
    ),
    "taxpose": (
        taxpose.PEER,
        TaxPoseConfig(width=32, heads=2, blocks=1, edge_layers=2, neighbours=8, points=48),
        {},
        taxpose.TaxPoseTraining(),
        150,
        3e-3,
    ),
}


def _motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    X = np.eye(4)
    X[:3, :3] = Rotation.random(rng=rng).as_matrix()
    X[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    return X


def _moved(X: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    return cloud @ X[:3, :3].T + X[:3, 3]


@pytest.mark.parametrize("name", TINY)
def test_the_pose_moves_with_either_cloud(name: str) -> None:
    """Untrained: whatever it says, it says of the objects and not of their frames."""
    torch.manual_seed(0)
    peer, sizes, options, *_ = TINY[name]
    net = peer.aligner.network(sizes)
    if name == "reldist":  # its distances are those of the demonstrations at first
        torch.nn.init.normal_(net.kernel[-1].weight, std=0.3)
    aligner = peer.aligner(net, **options)
    points = make_sample("validation", 3).points.astype(float)
    context = tuple(Alignment(points[0, n], points[1, n]) for n in range(2))
    before = aligner.align(context, points[0, -1], points[1, -1])
    F, W = _motion(1), _motion(2)
    turned = tuple(
        Alignment(_moved(X, a.grasped), _moved(X, a.target))
        for X, a in zip((_motion(3), _motion(4)), context, strict=True)
    )
    after = aligner.align(turned, _moved(F, points[0, -1]), _moved(W, points[1, -1]))
    np.testing.assert_allclose(after.poses[0], W @ before.poses[0] @ np.linalg.inv(F), atol=2e-3)
    np.testing.assert_allclose(after.energies, before.energies, rtol=1e-2)


@pytest.fixture(scope="module", params=TINY)
def learned(request: pytest.FixtureRequest) -> tuple[PeerAligner, np.ndarray]:
    """Trained on one pair of clouds alone, and these (2, P, 3)."""
    peer, sizes, options, config, steps, rate = TINY[request.param]
    whole = collate([make_sample("validation", 1, SampleConfig(cloud_points=96))])
    # Shown once, then asked.
    batch = {
        name: whole[name][:, :, -1:].repeat_interleave(2, 2)
        for name in ("points", "canonical", "present")
    }
    torch.manual_seed(0)
    net, generator = peer.aligner.network(sizes), torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(net.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.02, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        peer.loss(net, batch, config, generator).total.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return peer.aligner(net, **options), batch["points"][0, :, 0].double().numpy()


def _assert_put_back(aligner: PeerAligner, A: np.ndarray, B: np.ndarray, seed: int) -> None:
    """From new poses to within 5 mm and 3 degrees."""
    F, W = _motion(seed), _motion(10 + seed)
    estimate = aligner.align((Alignment(A, B),), _moved(F, A), _moved(W, B))
    off = np.linalg.inv(W) @ estimate.poses[0] @ F
    centre = A.mean(0)
    assert np.linalg.norm(_moved(off, centre) - centre) < 0.005
    assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 3


@pytest.mark.parametrize("seed", range(3))
def test_objects_that_were_learned_are_put_back(learned, seed: int) -> None:
    aligner, (A, B) = learned
    _assert_put_back(aligner, A, B, seed)


@pytest.mark.parametrize("index", range(3))
def test_a_landed_descriptor_field_puts_back_what_was_shown(index: int) -> None:
    """On objects that training never drew."""
    points = make_sample("unseen_categories", index).points.astype(float)
    _assert_put_back(RndfAligner(), points[0, -1], points[1, -1], index)
