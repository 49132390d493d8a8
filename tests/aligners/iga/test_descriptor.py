"""The descriptor network: invariances by axiom, over random clouds."""

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


def described(net: DescriptorNet, *cloud: torch.Tensor, **options) -> torch.Tensor:
    return net(*cloud, **options).descriptors


def test_descriptors_are_unit_vectors(net: DescriptorNet, cloud) -> None:
    norm = described(net, *cloud).norm(dim=-1)
    torch.testing.assert_close(norm, torch.ones_like(norm))


def test_invariant_under_rigid_motions(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    R = random_rotations(4, generator=torch.Generator().manual_seed(2))
    moved = points @ R.transpose(1, 2) + torch.randn(4, 1, 3, dtype=torch.float64)
    torch.testing.assert_close(
        described(net, moved, nodes), described(net, points, nodes), atol=1e-6, rtol=0
    )


def test_follows_a_permutation_of_points_and_nodes(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    order = torch.randperm(200)
    back = order.argsort()
    torch.testing.assert_close(
        described(net, points[:, order], back[nodes]), described(net, points, nodes)
    )
    shuffle = torch.randperm(24)
    torch.testing.assert_close(
        described(net, points, nodes[:, shuffle]), described(net, points, nodes)[:, shuffle]
    )


def test_independent_of_density_of_points(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    torch.testing.assert_close(
        described(net, points.repeat(1, 3, 1), nodes), described(net, points, nodes)
    )


def test_tells_left_from_right(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    mirror = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    assert (
        described(net, points * mirror, nodes) - described(net, points, nodes)
    ).abs().max() > 1e-3


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
    together = described(crossing, points, nodes, group=4)
    torch.testing.assert_close(
        described(crossing, moved, nodes, group=4), together, atol=1e-6, rtol=0
    )
    order = torch.tensor([2, 0, 3, 1])
    torch.testing.assert_close(
        described(crossing, points[order], nodes[order], group=4), together[order]
    )


def test_a_cloud_is_described_by_its_own_group_alone(crossing: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    pairs = described(crossing, points, nodes, group=2)
    assert (pairs - described(crossing, points, nodes)).abs().max() > 1e-3
    changed = points.clone()
    changed[3] *= torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
    again = described(crossing, changed, nodes, group=2)
    torch.testing.assert_close(again[:2], pairs[:2], atol=0, rtol=0)
    assert (again[2] - pairs[2]).abs().max() > 1e-4


def test_cross_layers_start_as_the_identity(net: DescriptorNet, cloud) -> None:
    torch.testing.assert_close(described(net, *cloud, group=4), described(net, *cloud))


def test_demonstrations_are_described_without_the_test_cloud(
    crossing: DescriptorNet, cloud
) -> None:
    """And the test cloud from them: it changes with each of them, whatever their order."""
    points, nodes = cloud
    shown = crossing(points[:3], nodes[:3], group=3)
    test = crossing(points[3:], nodes[3:], memory=shown.memory).descriptors
    assert (test - crossing(points[3:], nodes[3:]).descriptors).abs().max() > 1e-3
    order = torch.tensor([2, 0, 1])
    turned = crossing(points[order], nodes[order], group=3)
    again = crossing(points[3:], nodes[3:], memory=turned.memory).descriptors
    torch.testing.assert_close(again, test)
    for k in range(3):
        changed = points[:3].clone()
        changed[k] *= torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
        memory = crossing(changed, nodes[:3], group=3).memory
        other = crossing(points[3:], nodes[3:], memory=memory).descriptors
        assert (other - test).abs().max() > 1e-5


def test_objects_attend_to_their_own_demonstrations(crossing: DescriptorNet, cloud) -> None:
    """Two objects at once: as each alone."""
    points, nodes = cloud
    memory = crossing(points, nodes, group=2).memory
    both = crossing(points[1::2], nodes[1::2], memory=memory).descriptors
    for k in range(2):
        pair = slice(2 * k, 2 * k + 2)
        alone = crossing(points[pair], nodes[pair], group=2).memory
        one = 2 * k + 1
        found = crossing(points[one, None], nodes[one, None], memory=alone).descriptors
        torch.testing.assert_close(both[k : k + 1], found)


def test_up_turns_with_the_cloud_and_tells_top_from_bottom(net: DescriptorNet, cloud) -> None:
    points, nodes = cloud
    generator = torch.Generator().manual_seed(3)
    R = random_rotations(4, generator=generator)
    up = random_rotations(4, generator=generator)[:, 0]
    known = described(net, points, nodes, up=up)
    moved = described(net, points @ R.mT + 0.1, nodes, up=(R @ up[..., None])[..., 0])
    torch.testing.assert_close(moved, known, atol=1e-6, rtol=0)
    assert (described(net, points, nodes, up=-up) - known).abs().amax((1, 2)).min() > 1e-3
    assert (described(net, points, nodes) - known).abs().amax((1, 2)).min() > 1e-3
    some = up * torch.tensor([1.0, 0, 1, 0], dtype=torch.float64)[:, None]
    mixed = described(net, points, nodes, up=some)
    torch.testing.assert_close(mixed[1::2], described(net, points, nodes)[1::2])
    torch.testing.assert_close(mixed[::2], known[::2])


def test_all_nodes_belong_to_the_object_until_it_is_learned(net: DescriptorNet, cloud) -> None:
    assert net(*cloud).presence.shape == (4, 24)
    assert (net(*cloud).presence > 3).all()


def test_gradients_match_finite_differences() -> None:
    torch.manual_seed(0)
    sizes = DescriptorConfig(layers=1, scalars=8, vectors=4, heads=2, descriptor=4)
    small = DescriptorNet(sizes).double()
    points = torch.randn(1, 20, 3, dtype=torch.float64, requires_grad=True)
    nodes = torch.arange(6)[None]
    # The window of a shell reads positions too, so the check covers every path to the points.
    assert torch.autograd.gradcheck(lambda x: described(small, x, nodes), (points,), atol=1e-5)
