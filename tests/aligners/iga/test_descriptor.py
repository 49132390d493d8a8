"""The descriptor network: invariances by axiom, over random clouds."""

import copy

import pytest
import torch

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.geometry.se3 import random_rotations


@pytest.fixture(scope="module")
def net() -> DescriptorNet:
    torch.manual_seed(0)
    return DescriptorNet(DescriptorConfig(layers=2)).double()


@pytest.fixture
def cloud() -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.randn(4, 200, 3, generator=torch.Generator().manual_seed(1)).double() * 0.1
    return points, furthest_point_sampling(points, 24)


def test_descriptors_are_unit_vectors(net: DescriptorNet, cloud) -> None:
    norm = net(*cloud).norm(dim=-1)
    torch.testing.assert_close(norm, torch.ones_like(norm))


def test_invariant_under_rigid_motions(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    R = random_rotations(4, generator=torch.Generator().manual_seed(2))
    moved = points @ R.transpose(1, 2) + torch.randn(4, 1, 3, dtype=torch.float64)
    torch.testing.assert_close(net(moved, nodes), net(points, nodes), atol=1e-6, rtol=0)


def test_mixed_precision_is_the_same_and_invariant(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    mixed = copy.deepcopy(net).mixed_precision()
    found = mixed(points, nodes)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), net(points, nodes), atol=1e-5, rtol=0)
    R = random_rotations(4, generator=torch.Generator().manual_seed(2))
    moved = points @ R.transpose(1, 2) + torch.randn(4, 1, 3, dtype=torch.float64)
    torch.testing.assert_close(mixed(moved, nodes), found, atol=2e-6, rtol=0)


def test_follows_a_permutation_of_points_and_nodes(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    order = torch.randperm(200)
    back = order.argsort()
    torch.testing.assert_close(net(points[:, order], back[nodes]), net(points, nodes))
    shuffle = torch.randperm(24)
    torch.testing.assert_close(net(points, nodes[:, shuffle]), net(points, nodes)[:, shuffle])


def test_independent_of_density_of_points(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    torch.testing.assert_close(net(points.repeat(1, 3, 1), nodes), net(points, nodes))


def test_tells_left_from_right(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    assert (net(points * mirror, nodes) - net(points, nodes)).abs().max() > 1e-3


@pytest.fixture(scope="module")
def crossing() -> DescriptorNet:
    """A network whose cross layers, the identity at first, do something."""
    torch.manual_seed(0)
    net = DescriptorNet(DescriptorConfig(layers=3)).double()
    for layer in net.cross:
        torch.nn.init.normal_(layer.mlp[2].weight, std=0.1)
    return net


def test_clouds_described_together_move_separately(crossing: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    R = random_rotations(4, generator=torch.Generator().manual_seed(2))
    moved = points @ R.transpose(1, 2) + torch.randn(4, 1, 3, dtype=torch.float64)
    together = crossing(points, nodes, group=4)
    torch.testing.assert_close(crossing(moved, nodes, group=4), together, atol=1e-6, rtol=0)
    order = torch.tensor([2, 0, 3, 1])
    torch.testing.assert_close(crossing(points[order], nodes[order], group=4), together[order])


def test_a_cloud_is_described_by_its_own_group_alone(crossing: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    pairs = crossing(points, nodes, group=2)
    assert (pairs - crossing(points, nodes)).abs().max() > 1e-3
    changed = points.clone()
    changed[3] *= torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
    again = crossing(changed, nodes, group=2)
    torch.testing.assert_close(again[:2], pairs[:2], atol=0, rtol=0)
    assert (again[2] - pairs[2]).abs().max() > 1e-4


def test_cross_layers_start_as_the_identity(net: DescriptorNet, cloud) -> None:
    torch.testing.assert_close(net(*cloud, group=4), net(*cloud))


def test_gradients_match_finite_differences() -> None:
    torch.manual_seed(0)
    sizes = DescriptorConfig(layers=1, scalars=8, vectors=4, heads=2, descriptor=4)
    small = DescriptorNet(sizes).double()
    points = torch.randn(1, 20, 3, dtype=torch.float64, requires_grad=True)
    nodes = torch.arange(6)[None]
    # The window of a shell reads positions too, so the check covers every path to the points.
    assert torch.autograd.gradcheck(lambda x: small(x, nodes), (points,), atol=1e-5)
