"""R-NDF: the field turns with the object; where objects meet."""

import torch

from iga_drake.aligners.peers.rndf import DescriptorField, RndfConfig, meeting_place
from iga_drake.geometry.se3 import random_rotations


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
