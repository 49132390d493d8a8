"""TAX-Pose-DC: its layers."""

import torch

from iga_drake.aligners.peers.taxpose import EdgeLayer


def test_an_edge_layer_is_the_largest_over_the_nearest_points() -> None:
    torch.manual_seed(0)
    layer, x = EdgeLayer(3, 5, 4), torch.randn(1, 9, 3)
    out = layer(x)
    gap = x[0] - x[0, 2]
    near = gap.norm(dim=-1).argsort()[:4]
    each = gap[near] @ layer.difference.weight.T + layer.own(x[0, 2])
    expected = torch.nn.functional.leaky_relu(layer.norm(each.amax(0)), 0.2)
    torch.testing.assert_close(out[0, 2], expected, atol=1e-5, rtol=1e-5)
