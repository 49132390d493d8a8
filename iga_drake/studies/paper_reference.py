"""The alignment graph on PyTorch Geometric: one node for every part, one row for every edge.

The same network as `GraphNetwork`, with the same weights, from that library's `TransformerConv` and
`HeteroConv`: an independent reference to compare results and times with.
"""

import warnings
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from iga_drake.aligners.iga_paper.graph import (
    A,
    B,
    GraphConvolution,
    GraphNetwork,
    Nodes,
    edge_features,
    moved,
)
from iga_drake.errors import IgaDrakeError
from iga_drake.geometry.se3 import rigid

NAMES = ("A", "B")
Edge = tuple[str, str, str]


def _library() -> Any:
    try:
        import torch_geometric.nn
    except ModuleNotFoundError as error:
        raise IgaDrakeError(
            "PyTorch Geometric is not installed: pip install 'iga-drake[geometric]'"
        ) from error
    return torch_geometric.nn


class GraphReference(nn.Module):
    """Energies of M alignments of one problem; differentiable in poses, features and the weights
    that it has copied."""

    layers: Any  # HeteroConv each

    def __init__(self, network: GraphNetwork):
        super().__init__()
        config = network.config
        self.config = config
        pyg = _library()

        def linear(source: Any) -> nn.Linear:
            outputs, inputs = source.weight.shape
            copy = nn.Linear(inputs, outputs, bias=source.bias is not None)
            copy.weight.data = source.matrix().detach().clone()
            if source.bias is not None:
                copy.bias.data = source.bias.detach().clone()
            return copy

        def convolution(source: GraphConvolution) -> Any:
            edge = None if source.W6 is None else config.edge
            copy = pyg.TransformerConv(
                config.width, config.head_width, heads=config.heads, edge_dim=edge
            )
            copy.lin_skip, copy.lin_value = linear(source.W1), linear(source.W2)
            copy.lin_query, copy.lin_key = linear(source.W3), linear(source.W4)
            if source.W6 is not None:
                copy.lin_edge = linear(source.W6)
            return copy

        self.embed = linear(network.embed)
        self.class_token = nn.Parameter(network.class_token.detach().clone())
        self.demonstration_edge = nn.Parameter(network.demonstration_edge.detach().clone())
        self.mlp = nn.ModuleList(linear(layer) for layer in network.mlp)
        self.layers = nn.ModuleList()
        for layer in network.layers:
            convolutions: dict[Edge, Any] = {}
            if len(layer.within):
                between, across = convolution(layer.between), convolution(layer.demonstration)
                for role, other in ((A, B), (B, A)):
                    own, within = NAMES[role], convolution(layer.within[role])
                    for kind in ("demonstration", "test"):
                        node = f"{kind} {own}"
                        convolutions[node, "within", node] = within
                        convolutions[f"{kind} {NAMES[other]}", "between", node] = between
                    convolutions[f"demonstration {own}", "shows", f"test {own}"] = across
            for role, source in enumerate(layer.to_class):
                convolutions[f"test {NAMES[role]}", "to", "class"] = convolution(source)
            with warnings.catch_warnings():  # the last layer reaches the class node alone
                warnings.simplefilter("ignore")
                self.layers.append(pyg.HeteroConv(convolutions, aggr="sum"))

    def forward(
        self, demonstrations: tuple[Nodes, Nodes], test: tuple[Nodes, Nodes], R: Tensor, t: Tensor
    ) -> Tensor:
        """(M, outputs) at poses R (M, 3, 3), t (M, 3); nodes (N, K) of the demonstrations, (K,) of
        the test."""
        M = len(R)
        moving = moved(Nodes(*(part.expand(M, *part.shape) for part in test[A])), rigid(R, t))
        still = Nodes(*(part.expand(M, *part.shape) for part in test[B]))
        nodes = dict(zip(("test A", "test B"), (moving, still), strict=True))
        nodes |= dict(zip(("demonstration A", "demonstration B"), demonstrations, strict=True))
        features = {
            name: self.embed(v.flatten(-2) / self.config.vector_length).flatten(0, 1)
            for name, (_, v) in nodes.items()
        }
        features["class"] = self.class_token.expand(M, -1)
        indices: dict[Edge, Tensor] = {}
        attributes: dict[Edge, Tensor] = {}
        for edge, source, destination in self._edges(nodes):
            indices[edge] = torch.stack((source, destination))
            _, kind, end = edge
            if kind == "shows":
                embedding = self.demonstration_edge[NAMES.index(end[-1])]
                attributes[edge] = embedding.expand(len(source), -1)
            elif kind != "to":
                p, q = (nodes[name].positions.flatten(0, 1) for name in (edge[0], edge[2]))
                attributes[edge] = edge_features(
                    p[source] - q[destination], self.config.frequencies
                )
        for layer in self.layers:
            some = {edge: index for edge, index in indices.items() if edge in layer.convs}
            found = layer(features, some, edge_attr_dict=attributes)
            features = {name: nn.functional.gelu(value) for name, value in found.items()}
        c = features["class"]
        for linear in self.mlp[:-1]:
            c = nn.functional.gelu(linear(c))
        return self.mlp[-1](c)

    @staticmethod
    def _edges(nodes: dict[str, Nodes]) -> Iterator[tuple[Edge, Tensor, Tensor]]:
        """Types of edges with the flat indices of their sources and destinations."""

        def pairs(graphs: int, sources: int, ends: int) -> tuple[Tensor, Tensor]:
            graph, source, end = torch.meshgrid(
                torch.arange(graphs), torch.arange(sources), torch.arange(ends), indexing="ij"
            )
            return (graph * sources + source).flatten(), (graph * ends + end).flatten()

        for kind in ("demonstration", "test"):
            G, K = nodes[f"{kind} A"].positions.shape[:2]
            for own, other in (("A", "B"), ("B", "A")):
                yield (f"{kind} {own}", "within", f"{kind} {own}"), *pairs(G, K, K)
                yield (f"{kind} {other}", "between", f"{kind} {own}"), *pairs(G, K, K)
        M, K = nodes["test A"].positions.shape[:2]
        shown = nodes["demonstration A"].positions[..., 0].numel()
        for own in NAMES:
            yield (f"demonstration {own}", "shows", f"test {own}"), *pairs(1, shown, M * K)
            yield (f"test {own}", "to", "class"), *pairs(M, K, 1)
