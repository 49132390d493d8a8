"""The graph network against PyTorch Geometric, against loops over edges, and under motions."""

import math

import pytest
import torch
from paper_networks import CHANNELS, SMALL, double, network, problem
from torch import nn

from iga_drake.aligners.iga_paper.graph import (
    GraphConfig,
    GraphError,
    GraphNetwork,
    Nodes,
    SpectralLinear,
    edge_features,
    moved,
)
from iga_drake.geometry.se3 import random_rotations, rigid


def energies(net: GraphNetwork, demonstrations, test, R, t) -> torch.Tensor:
    return net(net.context(demonstrations, test), R, t)


@pytest.mark.parametrize("outputs", [1, 9])
def test_equal_to_pytorch_geometric(outputs: int) -> None:
    """The paper's sizes, single precision, values and gradients by poses."""
    pytest.importorskip("torch_geometric")
    from iga_drake.studies.paper_reference import GraphReference

    torch.manual_seed(1)
    net = network(GraphConfig(), outputs=outputs)
    reference = GraphReference(net)
    demonstrations, test, R, t = problem(S=1, N=4, M=6)
    R.requires_grad_(), t.requires_grad_()
    found = energies(net, demonstrations, test, R, t)[0]
    first = [tuple(Nodes(*(x[0] for x in n)) for n in pair) for pair in (demonstrations, test)]
    expected = reference(*first, R[0], t[0])
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    weights = torch.randn_like(found)
    ours = torch.autograd.grad((found * weights).sum(), (R, t))
    theirs = torch.autograd.grad((expected * weights).sum(), (R, t))
    for mine, other in zip(ours, theirs, strict=True):
        assert other.abs().max() > 1e-4
        torch.testing.assert_close(mine, other, atol=1e-5, rtol=1e-4)


def _attention(convolution, F_i, F_js, e_ijs, H) -> torch.Tensor:
    """The paper's equation for one node, one head after the other."""
    heads = []
    d = len(F_i) // H
    for h in range(H):
        part = slice(h * d, (h + 1) * d)
        carried = [torch.zeros(d, dtype=F_i.dtype)] * len(F_js)
        if convolution.W6 is not None:
            carried = [convolution.W6(e)[part] for e in e_ijs]
        q = convolution.W3(F_i)[part]
        logits = [
            q @ (convolution.W4(F_j)[part] + e) / math.sqrt(d)
            for F_j, e in zip(F_js, carried, strict=True)
        ]
        alpha = torch.stack(logits).softmax(0)
        heads.append(
            sum(
                a * (convolution.W2(F_j)[part] + e)
                for a, F_j, e in zip(alpha, F_js, carried, strict=True)
            )
        )
    return convolution.W1(F_i) + torch.cat(heads)


def _by_loops(net: GraphNetwork, demonstrations, test) -> torch.Tensor:
    """Of one problem and the pose in which the test's nodes are; edge by edge."""
    H, L, gelu = net.config.heads, net.config.frequencies, nn.functional.gelu
    graphs = [[Nodes(*(x[0, n] for x in o)) for o in demonstrations] for n in range(3)]
    graphs.append([Nodes(*(x[0] for x in o)) for o in test])
    h = [[[net.embed(v.flatten() / 5) for v in o.vectors] for o in graph] for graph in graphs]
    c = net.class_token
    for layer in net.layers:
        new_c = sum(_attention(layer.to_class[r], c, h[-1][r], [], H) for r in (0, 1))
        if len(layer.within):
            new = []
            for g, graph in enumerate(graphs):
                new.append([])
                for r in (0, 1):
                    new[g].append([])
                    for i, F in enumerate(h[g][r]):

                        def e(role, g=g, graph=graph, r=r, i=i):
                            p = graph[r].positions[i]
                            return [edge_features(q - p, L) for q in graph[role].positions]

                        total = _attention(layer.within[r], F, h[g][r], e(r), H)
                        total = total + _attention(layer.between, F, h[g][1 - r], e(1 - r), H)
                        if g == 3:
                            shown = [F_j for n in range(3) for F_j in h[n][r]]
                            learned = [net.demonstration_edge[r]] * len(shown)
                            total = total + _attention(layer.demonstration, F, shown, learned, H)
                        new[g][r].append(gelu(total))
            h = new
        c = gelu(new_c)
    for linear in net.mlp[:-1]:
        c = gelu(linear(c))
    return net.mlp[-1](c)


def test_equal_to_the_equation_edge_by_edge() -> None:
    net = network().double()
    demonstrations, test, R, t = double(problem(S=1, M=2))
    found = energies(net, demonstrations, test, R, t)[0]
    for pose in range(2):
        placed = moved(test[0], rigid(R[:, pose], t[:, pose]))
        expected = _by_loops(net, demonstrations, (placed, test[1]))
        torch.testing.assert_close(found[pose], expected, atol=1e-9, rtol=0)


def test_a_pose_is_a_motion_of_the_nodes() -> None:
    """Also where another motion went before."""
    net = network().double()
    demonstrations, test, R, t = double(problem())
    expected = energies(net, demonstrations, test, R, t)
    G = random_rotations(2), torch.randn(2, 3).double()
    before = (moved(test[0], rigid(*G)), test[1])
    R2 = R @ G[0][:, None].mT
    t2 = t - (R2 @ G[1][:, None, :, None])[..., 0]
    torch.testing.assert_close(energies(net, demonstrations, before, R2, t2), expected)
    assert (expected[:, :1] - expected[:, 1:]).abs().max() > 1e-3


def test_only_differences_of_positions_within_a_frame_matter() -> None:
    net = network().double()
    demonstrations, test, R, t = double(problem())
    expected = energies(net, demonstrations, test, R, t)
    shift = torch.randn(2, 3, 1, 3).double()
    elsewhere = tuple(Nodes(p + shift, v) for p, v in demonstrations)
    torch.testing.assert_close(energies(net, elsewhere, test, R, t), expected)
    one_object = (Nodes(demonstrations[0][0] + shift, demonstrations[0][1]), demonstrations[1])
    assert (energies(net, one_object, test, R, t) - expected).abs().max() > 1e-4


def test_the_orders_of_nodes_and_demonstrations_do_not_matter() -> None:
    net = network().double()
    demonstrations, test, R, t = double(problem())
    expected = energies(net, demonstrations, test, R, t)
    order, nodes = torch.randperm(3), torch.randperm(SMALL.nodes)
    shuffled = tuple(Nodes(*(x[:, order][:, :, nodes] for x in part)) for part in demonstrations)
    asked = tuple(Nodes(*(x[:, nodes.flip(0)] for x in part)) for part in test)
    torch.testing.assert_close(energies(net, shuffled, asked, R, t), expected)
    fewer = tuple(Nodes(*(x[:, :1] for x in part)) for part in demonstrations)
    assert (energies(net, fewer, test, R, t) - expected).abs().max() > 1e-4


def test_given_edges_take_the_place_of_the_poses() -> None:
    net = network().double()
    demonstrations, test, R, t = double(problem())
    context = net.context(demonstrations, test)
    edges = net.edges_between(context, R, t)
    expected = net(context, R, t)
    torch.testing.assert_close(net(context, R, 5 * t, edges), expected)


def test_positional_encoding_of_known_positions() -> None:
    features = edge_features(torch.tensor([0.5, 0.0, -0.25]), 2)
    s = math.sqrt(0.5)
    sines, cosines = [1, 0, -s, 0, 0, -1], [0, 1, s, -1, 1, 0]
    torch.testing.assert_close(features, torch.tensor([*sines, *cosines]), atol=1e-6, rtol=0)


def test_spectral_normalisation_makes_the_largest_singular_value_one() -> None:
    torch.manual_seed(0)
    layer = SpectralLinear(12, 7, spectral=True)
    layer.weight.data *= 9
    layer.power_iteration(300)
    assert torch.linalg.svdvals(layer.matrix())[0].item() == pytest.approx(1, abs=1e-5)
    plain = SpectralLinear(12, 7, spectral=False)
    assert torch.equal(plain.matrix(), plain.weight) and len(list(plain.parameters())) == 2
    # The gradient is that of W / sigma(W), which no scale of W changes.
    weights = torch.randn(7, 12)
    (gradient,) = torch.autograd.grad((layer.matrix() * weights).sum(), layer.weight)
    assert (gradient * layer.weight).sum().item() == pytest.approx(0, abs=1e-5)
    assert gradient.abs().max() > 1e-3


def test_sizes() -> None:
    counts = {
        name: sum(
            p.numel()
            for p in GraphNetwork(GraphConfig.of_size(name), channels=128).parameters()
            if p.requires_grad
        )
        for name in ("full", "medium", "small")
    }
    assert 5.5e6 < counts["full"] < 5.9e6
    assert counts["small"] < counts["medium"] / 3 < counts["full"] / 10
    with pytest.raises(GraphError, match="full, medium, small"):
        GraphConfig.of_size("huge")
    with pytest.raises(GraphError, match="heads = 0"):
        GraphConfig(heads=0)


def test_every_weight_is_used() -> None:
    net = network()
    energies(net, *problem()).square().sum().backward()
    # A bias that shifts all logits of a softmax, and the keys' embedding, have no effect.
    without = {n for n, p in net.named_parameters() if p.requires_grad and p.grad is None}
    assert all(name.endswith("W4.bias") for name in without), without
    assert net.demonstration_edge.grad.abs().max() > 0 and CHANNELS == 5
