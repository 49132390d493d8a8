"""R-NDF: the field turns with the object, and the landed one finds known objects again."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from iga_drake.aligners.peers.rndf import DescriptorField, RndfAligner, RndfConfig, meeting_place
from iga_drake.dataset.samples import make_sample
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.geometry.se3 import random_rotations


def _motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    X = np.eye(4)
    X[:3, :3] = Rotation.random(rng=rng).as_matrix()
    X[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    return X


def _moved(X: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    return cloud @ X[:3, :3].T + X[:3, 3]


def test_places_that_turn_with_the_cloud_keep_their_descriptors() -> None:
    torch.manual_seed(0)
    net = DescriptorField(RndfConfig(channels=6, latent=5, blocks=2, width=8, layers=2)).double()
    cloud, places = (torch.randn(2, n, 3, dtype=torch.float64) for n in (60, 9))
    R = random_rotations(2, generator=torch.Generator().manual_seed(1))
    before = net.describe(net.encode(cloud), places)
    after = net.describe(net.encode(cloud @ R.mT), places @ R.mT)
    for one, two in zip(before, after, strict=True):
        torch.testing.assert_close(two, one)
    # Handed: a mirrored cloud is another one.
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    mirrored = net.describe(net.encode(cloud @ mirror), places @ mirror)
    assert (mirrored[1] - before[1]).abs().max() > 1e-3


def test_objects_meet_where_they_are_nearest() -> None:
    A = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    B = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 0.1
    A[0], B[0] = torch.tensor([0.2, 0.05, 0.05]), torch.tensor([0.22, 0.05, 0.05])
    B[1:, 0] += 0.4
    torch.testing.assert_close(
        meeting_place(A, B, near=0.001), torch.tensor([0.21, 0.05, 0.05]), atol=1e-4, rtol=0
    )


@pytest.mark.parametrize("index", range(3))
def test_the_demonstrated_objects_in_new_poses_are_put_back(index: int) -> None:
    """The landed weights, on objects that training never drew."""
    sample = make_sample("unseen_categories", index)
    A, B = (sample.points[role, -1].astype(float) for role in range(2))
    F, W = _motion(index), _motion(10 + index)
    estimate = RndfAligner().align((Alignment(A, B),), _moved(F, A), _moved(W, B))
    off = np.linalg.inv(W) @ estimate.poses[0] @ F
    centre = A.mean(0)
    assert np.linalg.norm(_moved(off, centre) - centre) < 0.005
    assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 3
