"""The heterogeneous alignment graph and the network on it (paper, "Alignment Representation",
"Learning the Conditional Alignment Distribution" and appendix "Energy Based Model").

Nodes are parts of objects: a position and a feature, here vectors of the local encoder, which turn
with the object. Node types: A (grasped), B (target), one pair of such sets per alignment, and a
class node per candidate alignment of the test objects. Edge types, each with weights of its own:

    A-A, B-B        every node of an object with every node of it, itself included
    A-B             both ways between the objects of an alignment
    demonstration   from every node of every demonstration to the test nodes of the same object
    A-class, B-class  from the test nodes to the class node of their alignment

The weights of A-A, B-B and A-B are shared by the demonstrations and the test alignment. Information
flows one way, from demonstrations to test to class, so the demonstrations never see a candidate
pose: `GraphNetwork.context` computes once all that the pose of the grasped object leaves alone,
`GraphNetwork.forward` the rest for any number of poses. Dense tensors stand for the graph:

    S problems, N demonstrations, M poses, K nodes of an object, C vectors of a node,
    D = H d features in H heads of width d, E numbers of an edge

The paper leaves open: GELU stands between the convolutions; the messages of several edge types add
up; the embeddings of demonstration edges are one for each object. The last convolution reaches the
class node alone, nothing else of it would be used.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from iga_drake.errors import IgaDrakeError
from iga_drake.geometry.se3 import transform

A, B = 0, 1


class GraphError(IgaDrakeError):
    """Sizes of the graph network that don't fit each other or what it is given."""


@dataclass(frozen=True)
class GraphConfig:
    """Sizes of the graph network; the defaults are the paper's, about 5.7 M parameters."""

    heads: int = 4
    head_width: int = 64
    convolutions: int = 4
    hidden: int = 256  # of the two layers of the final MLP
    frequencies: int = 6  # L of the positional encoding of edges
    nodes: int = 8  # K
    spectral: bool = True  # spectral normalisation of every weight matrix
    vector_length: float = 5.0  # typical length of the encoder's vectors: the unit of the features

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name != "spectral" and not value > 0:
                raise GraphError(f"GraphConfig.{field.name} = {value}, must be above 0")

    @property
    def width(self) -> int:
        """D."""
        return self.heads * self.head_width

    @property
    def edge(self) -> int:
        """E."""
        return 6 * self.frequencies

    @classmethod
    def of_size(cls, name: str) -> "GraphConfig":
        """One of SIZES. Raises `GraphError`."""
        if name not in SIZES:
            raise GraphError(f"size '{name}' is not known; one of: {', '.join(SIZES)}")
        return SIZES[name]


# The paper's, and smaller ones for machines without a GPU.
SIZES = {
    "full": GraphConfig(),
    "medium": GraphConfig(head_width=32, hidden=128),
    "small": GraphConfig(head_width=16, hidden=64),
}


class Nodes(NamedTuple):
    """Parts of objects."""

    positions: Tensor  # (..., K, 3) m
    vectors: Tensor  # (..., K, 3, C), turn with the object


def moved(nodes: Nodes, X: Tensor) -> Nodes:
    """The nodes (..., K) after the rigid motion X (..., 4, 4) (paper, eq. "update")."""
    return Nodes(
        transform(X, nodes.positions),
        torch.einsum("...ab,...kbc->...kac", X[..., :3, :3], nodes[1]),
    )


def edge_features(difference: Tensor, frequencies: int) -> Tensor:
    """Positional encodings of relative positions p_j - p_i (..., 3) m (paper, eq. "positional").

    (..., 6 L): sines of 2^l pi times x, y, z for l = 0 to L - 1, then the cosines.
    """
    scale = torch.pi * 2.0 ** torch.arange(frequencies, device=difference.device)
    phase = (difference[..., None, :] * scale.to(difference)[:, None]).flatten(-2)
    return torch.cat((phase.sin(), phase.cos()), -1)


class SpectralLinear(nn.Module):
    """A linear layer whose matrix is divided by its largest singular value (Miyato et al.,
    "Spectral Normalization for Generative Adversarial Networks", ICLR 2018), where asked for.

    `left` estimates the left singular vector; `power_iteration` improves it. It is a parameter
    without gradient, so that it is saved, resumed and averaged like the weights.
    """

    def __init__(self, inputs: int, outputs: int, *, spectral: bool, bias: bool = True):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs) / inputs**0.5)
        self.bias = nn.Parameter(torch.zeros(outputs)) if bias else None
        self.left = None
        if spectral:
            left = nn.functional.normalize(torch.randn(outputs), dim=0)
            self.left = nn.Parameter(left, requires_grad=False)
            self.power_iteration(8)

    @torch.no_grad()
    def power_iteration(self, count: int = 1) -> None:
        """Improves the estimate of the largest singular value."""
        if self.left is None:
            return
        for _ in range(count):
            right = nn.functional.normalize(self.left @ self.weight, dim=0)
            self.left.copy_(nn.functional.normalize(self.weight @ right, dim=0))

    def matrix(self) -> Tensor:
        """(outputs, inputs), normalised; differentiable in the weight."""
        if self.left is None:
            return self.weight
        with torch.no_grad():
            left = nn.functional.normalize(self.left, dim=0)
            right = nn.functional.normalize(left @ self.weight, dim=0)
        return self.weight / (left @ (self.weight @ right))

    def forward(self, x: Tensor) -> Tensor:
        return nn.functional.linear(x, self.matrix(), self.bias)


class GraphConvolution(nn.Module):
    """Weights of one graph transformer convolution over one type of edges (paper, eq.
    "graph_conv"):

        F_i' = W1 F_i + sum_j alpha_ij (W2 F_j + W6 e_ij)
        alpha_ij = softmax_j((W3 F_i)^T (W4 F_j + W6 e_ij) / sqrt(d))

    in each of H heads. W1 to W4 have biases, W6 has none; W6 is there where edges have features.
    """

    def __init__(self, config: GraphConfig, *, edge: bool):
        super().__init__()
        D, spectral = config.width, config.spectral
        self.W1 = SpectralLinear(D, D, spectral=spectral)
        self.W2 = SpectralLinear(D, D, spectral=spectral)
        self.W3 = SpectralLinear(D, D, spectral=spectral)
        self.W4 = SpectralLinear(D, D, spectral=spectral)
        self.W6 = None
        if edge:
            self.W6 = SpectralLinear(config.edge, D, spectral=spectral, bias=False)

    def edge_matrix(self, heads: int) -> Tensor:
        """W6 as (H, d, E)."""
        assert self.W6 is not None
        return self.W6.matrix().unflatten(0, (heads, -1))


class _Projection(NamedTuple):
    """Several linear maps of the same nodes, stacked."""

    matrix: Tensor  # (P D, D)
    bias: Tensor  # (P D,)
    heads: int

    @staticmethod
    def of(maps: "list[_Map]", heads: int) -> "_Projection":
        """From P maps."""
        matrices, biases = zip(*maps, strict=True)
        return _Projection(torch.cat(matrices), torch.cat(biases), heads)

    def __call__(self, h: Tensor) -> tuple[Tensor, ...]:
        """Features (S, M, K, D) to P tensors (H, S, M, K, d)."""
        mapped = nn.functional.linear(h, self.matrix, self.bias)
        mapped = mapped.unflatten(-1, (-1, self.heads, h.shape[-1] // self.heads))
        return mapped.permute(3, 4, 0, 1, 2, 5).contiguous().unbind(0)

    def of_rotated(self, Y: Tensor, bias: Tensor) -> "_OfRotation":
        """The maps of features sum_r R_r Y_r + bias, Y (S, 9, K, D), as functions of R."""
        H, D = self.heads, Y.shape[-1]
        coefficients = nn.functional.linear(Y, self.matrix).unflatten(-1, (-1, H, D // H))
        constant = nn.functional.linear(bias, self.matrix, self.bias)
        return _OfRotation(
            coefficients.permute(3, 4, 0, 1, 2, 5).contiguous(),
            constant.view(-1, H, 1, 1, 1, D // H),
        )


class _OfRotation(NamedTuple):
    """Features that are linear in a rotation."""

    coefficients: Tensor  # (P, H, S, 9, K, d)
    constant: Tensor  # (P, H, 1, 1, 1, d)

    def __call__(self, R: Tensor) -> tuple[Tensor, ...]:
        """P tensors (H, S, M, K, d) at rotations (S, M, 3, 3)."""
        P, H, _, _, K, _ = self.coefficients.shape
        linear = R.flatten(-2) @ self.coefficients.flatten(0, 1).flatten(-2)  # (P H, S, M, K d)
        return (linear.unflatten(-1, (K, -1)).unflatten(0, (P, H)) + self.constant).unbind(0)


_Map = tuple[Tensor, Tensor]  # matrix (D, D) and bias (D,)


def _map(linear: SpectralLinear) -> _Map:
    assert linear.bias is not None
    return linear.matrix(), linear.bias


def _sum(maps: list[_Map]) -> _Map:
    matrices, biases = zip(*maps, strict=True)
    return torch.stack(matrices).sum(0), torch.stack(biases).sum(0)


def _attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Messages (..., I, d) along edges without features: q (..., I, d), k and v (..., J, d)."""
    return (q @ k.mT / math.sqrt(q.shape[-1])).softmax(-1) @ v


def _attend_edges(q: Tensor, k: Tensor, v: Tensor, e: Tensor, W6: Tensor) -> Tensor:
    """Messages (H, S, M, I, d) to nodes i from nodes j.

    q (H, S, M, I, d), k and v (H, S, M, J, d), e (S, M, I, J, E), W6 (H, d, E).

    q_i . W6 e_ij = (W6^T q_i) . e_ij and sum_j alpha_ij W6 e_ij = W6 sum_j alpha_ij e_ij: so W6
    multiplies nodes and not pairs of nodes.
    """
    turned = (q.flatten(1, -2) @ W6).view(*q.shape[:-1], -1)  # (H, S, M, I, E)
    along = (e @ turned.movedim(0, -1)).movedim(-1, 0)  # (H, S, M, I, J)
    alpha = ((q @ k.mT + along) / math.sqrt(q.shape[-1])).softmax(-1)
    carried = (alpha.movedim(0, -2) @ e).movedim(-2, 0)  # (H, S, M, I, E)
    return alpha @ v + (carried.flatten(1, -2) @ W6.mT).view(*carried.shape[:-1], -1)


def _join(messages: Tensor) -> Tensor:
    """Heads side by side: (H, S, M, K, d) to (S, M, K, D)."""
    return messages.movedim(0, -2).flatten(-2)


class GraphLayer(nn.Module):
    """One convolution over all types of edges. The last one reaches the class node alone."""

    within: Any  # GraphConvolution of A-A and of B-B; empty in the last layer
    to_class: Any  # of A-class and of B-class

    def __init__(self, config: GraphConfig, *, last: bool):
        super().__init__()
        self.heads = config.heads
        self.within = nn.ModuleList()
        if not last:
            self.within.extend(GraphConvolution(config, edge=True) for _ in (A, B))
            self.between = GraphConvolution(config, edge=True)
            self.demonstration = GraphConvolution(config, edge=True)
        self.to_class = nn.ModuleList(GraphConvolution(config, edge=False) for _ in (A, B))

    def projections(self, role: int) -> tuple[_Projection, _Projection]:
        """Projections of the nodes of one object: a demonstration's (P = 9) and the test's (P = 8).

        P in order: queries, keys and values within the object; between the objects; then for a
        demonstration keys and values along demonstration edges, for the test queries; W1 F, summed.
        """
        within, between, across = self.within[role], self.between, self.demonstration
        maps = [_map(W) for W in (within.W3, within.W4, within.W2)]
        maps += [_map(W) for W in (between.W3, between.W4, between.W2)]
        own = [_map(within.W1), _map(between.W1)]
        shown = [_map(across.W4), _map(across.W2), _sum(own)]
        asked = [_map(across.W3), _sum([*own, _map(across.W1)])]
        return _Projection.of(maps + shown, self.heads), _Projection.of(maps + asked, self.heads)

    def class_update(self, c: Tensor, h: tuple[Tensor, Tensor]) -> Tensor:
        """Class nodes (S, M, D) from themselves and the test nodes h (S, M, K, D) of A and B.

        (W3 c)^T (W4 F_j) = (W4^T W3 c)^T F_j and sum_j alpha_j W2 F_j = W2 sum_j alpha_j F_j: W4
        and W2 multiply the class node, not every test node; W4's bias drops out of the softmax.
        """
        H, total = self.heads, torch.zeros_like(c)
        for convolution, nodes in zip(self.to_class, h, strict=True):
            q = convolution.W3(c).unflatten(-1, (H, -1))  # (S, M, H, d)
            W4, W2 = (W.matrix().unflatten(0, (H, -1)) for W in (convolution.W4, convolution.W2))
            asked = torch.einsum("smhd,hdf->smhf", q, W4)
            alpha = (asked @ nodes.mT / math.sqrt(q.shape[-1])).softmax(-1)  # (S, M, H, K)
            pooled = torch.einsum("smhf,hdf->smhd", alpha @ nodes, W2).flatten(-2)
            total = total + convolution.W1(c) + pooled + convolution.W2.bias
        return nn.functional.gelu(total)


class _Memory(NamedTuple):
    """Keys and values of one object's nodes in all demonstrations."""

    k: Tensor  # (H, S, N K, d)
    v: Tensor


class _LayerContext(NamedTuple):
    """The inputs of every layer but the last that don't depend on the candidate alignments."""

    asked: tuple[_Projection, _Projection]  # of the test nodes of A and B
    within: tuple[Tensor, Tensor]  # W6 (H, d, E)
    between: Tensor
    memory: tuple[_Memory, _Memory]


class Context(NamedTuple):
    """Features of S problems that don't depend on the poses of the grasped objects."""

    positions: tuple[Tensor, Tensor]  # (S, K, 3) of the test's A and B
    edges_B: Tensor  # (S, 1, K, K, E)
    layers: list[_LayerContext]
    # The first layer: A's features and their projections are linear in the rotation, B's are known.
    features_A: _OfRotation  # P = H = 1
    projected_A: _OfRotation
    features_B: Tensor  # (S, 1, K, D)
    projected_B: tuple[Tensor, ...]  # P of (H, S, 1, K, d)
    message_B: Tensor  # (H, S, 1, K, d), all but what A tells


class GraphNetwork(nn.Module):
    """From demonstrations and candidate alignments to numbers for each candidate.

    outputs: 1 for an energy; the variants of the paper have others.
    channels: C of the encoder.
    """

    layers: Any  # GraphLayer each

    def __init__(self, config: GraphConfig, *, channels: int, outputs: int = 1):
        super().__init__()
        self.config = config
        D, spectral = config.width, config.spectral
        self.embed = SpectralLinear(3 * channels, D, spectral=spectral)
        self.demonstration_edge = nn.Parameter(torch.randn(2, config.edge))  # for A and B
        self.class_token = nn.Parameter(torch.randn(D))
        last = config.convolutions - 1
        self.layers = nn.ModuleList(
            GraphLayer(config, last=layer == last) for layer in range(config.convolutions)
        )
        self.mlp = nn.ModuleList(
            SpectralLinear(inputs, width, spectral=spectral)
            for inputs, width in (
                (D, config.hidden),
                (config.hidden, config.hidden),
                (config.hidden, outputs),
            )
        )

    def power_iteration(self, count: int = 1) -> None:
        """Improves the estimated singular values of all matrices; once a step of training."""
        for module in self.modules():
            if isinstance(module, SpectralLinear):
                module.power_iteration(count)

    def context(self, demonstrations: tuple[Nodes, Nodes], test: tuple[Nodes, Nodes]) -> Context:
        """Features of problems that are computed once, for all candidate poses.

        Args:
          demonstrations: nodes of A and B, (S, N, K), both in one frame for each alignment.
          test: nodes of A and B, (S, K); B in its frame, A in any: poses carry it to B's.

        Only differences of positions within a frame matter.
        """
        L = self.config.frequencies
        h = [self._embed(nodes.vectors) for nodes in demonstrations]  # (S, N, K, D)
        p = [nodes.positions for nodes in demonstrations]
        e = [[edge_features(p[j][..., None, :, :] - p[i][..., None, :], L) for j in (A, B)]
             for i in (A, B)]  # fmt: skip
        layers = []
        for number, layer in enumerate(self.layers[:-1]):
            shown, asked = zip(*(layer.projections(role) for role in (A, B)), strict=True)
            within = tuple(w.edge_matrix(layer.heads) for w in layer.within)
            between = layer.between.edge_matrix(layer.heads)
            embedding = torch.einsum(  # W6 e of demonstration edges: shifts no softmax
                "hde,re->rhd", layer.demonstration.edge_matrix(layer.heads), self.demonstration_edge
            )[:, :, None, None]
            own = [project(features) for project, features in zip(shown, h, strict=True)]
            memory_A, memory_B = (
                _Memory(own[r][6].flatten(2, 3), own[r][7].flatten(2, 3) + embedding[r])
                for r in (A, B)
            )
            layers.append(_LayerContext(asked, within, between, (memory_A, memory_B)))
            if number < len(self.layers) - 2:
                h = [
                    nn.functional.gelu(
                        _join(
                            own[i][8]
                            + _attend_edges(own[i][0], own[i][1], own[i][2], e[i][i], within[i])
                            + _attend_edges(own[i][3], own[j][4], own[j][5], e[i][j], between)
                        )
                    )
                    for i, j in ((A, B), (B, A))
                ]
        return self._first_layer(layers, test, L)

    def _first_layer(
        self, layers: list[_LayerContext], test: tuple[Nodes, Nodes], L: int
    ) -> Context:
        """The context with the first layer's features of the test nodes that need no pose."""
        first = layers[0]
        # F = W R V + b = sum_(x y) R_xy W_x V_y + b, for the axes x, y of the vectors V.
        W = self.embed.matrix().unflatten(1, (3, -1))  # (D, 3, C)
        V = test[A].vectors / self.config.vector_length
        Y = torch.einsum("dxc,skyc->sxykd", W, V).flatten(1, 2)  # (S, 9, K, D)
        assert self.embed.bias is not None
        itself = _OfRotation(Y[None, None], self.embed.bias.view(1, 1, 1, 1, 1, -1))
        h_B = self._embed(test[B].vectors)[:, None]
        own_B = first.asked[B](h_B)
        p_B = test[B].positions
        e_BB = edge_features(p_B[:, None, :] - p_B[:, :, None], L)[:, None]
        message_B = (
            own_B[7]
            + _attend_edges(own_B[0], own_B[1], own_B[2], e_BB, first.within[B])
            + self._recall(own_B[6], first.memory[B])
        )
        return Context(
            positions=(test[A].positions, p_B),
            edges_B=e_BB,
            layers=layers,
            features_A=itself,
            projected_A=first.asked[A].of_rotated(Y, self.embed.bias),
            features_B=h_B,
            projected_B=own_B,
            message_B=message_B,
        )

    def _embed(self, vectors: Tensor) -> Tensor:
        """Features (..., D) of vectors (..., 3, C)."""
        return self.embed(vectors.flatten(-2) / self.config.vector_length)

    @staticmethod
    def _recall(q: Tensor, memory: _Memory) -> Tensor:
        """Messages (H, S, M, K, d) of the demonstrations to test nodes with queries q."""
        return _attend(q.flatten(2, 3), memory.k, memory.v).view(q.shape)

    def edges_between(self, context: Context, R: Tensor, t: Tensor) -> Tensor:
        """Features (S, M, K, K, E) of the edges to A's nodes from B's, A at poses R, t."""
        p_A, p_B = context.positions
        with torch.autocast(R.device.type, enabled=False):  # positions need their digits
            p_A = p_A[:, None] @ R.mT + t[..., None, :]  # (S, M, K, 3)
            return edge_features(p_B[:, None, None] - p_A[..., None, :], self.config.frequencies)

    def _edges_of_A(self, context: Context, R: Tensor) -> Tensor:
        """Features (S, M, K, K, E) of the edges between A's nodes."""
        with torch.autocast(R.device.type, enabled=False):
            p_A = context.positions[A][:, None] @ R.mT  # (S, M, K, 3)
            return edge_features(p_A[..., None, :, :] - p_A[..., None, :], self.config.frequencies)

    def forward(
        self, context: Context, R: Tensor, t: Tensor, edges: Tensor | None = None
    ) -> Tensor:
        """Outputs (S, M, outputs) for M poses of each test's grasped object.

        Args:
          context: of S problems.
          R: (S, M, 3, 3) rotations from A's frame to B's; t: (S, M, 3) m.
          edges: of A and B in place of `edges_between`, for derivatives by them.
        """
        e_AB = self.edges_between(context, R, t) if edges is None else edges
        # The way back has the opposite difference: sines change their signs.
        sign = torch.ones(self.config.edge, device=R.device, dtype=e_AB.dtype)
        sign[: self.config.edge // 2] = -1
        e_BA = (e_AB * sign).transpose(2, 3).contiguous()
        e_AA = self._edges_of_A(context, R)
        c = self.class_token.expand(*R.shape[:2], -1)
        # First layer.
        first = context.layers[0]
        own_A, own_B = context.projected_A(R), context.projected_B
        h: tuple[Tensor, Tensor] = (context.features_A(R)[0][0], context.features_B)
        q_B = own_B[3].expand(-1, -1, R.shape[1], -1, -1)
        to_A = (
            own_A[7]
            + _attend_edges(own_A[0], own_A[1], own_A[2], e_AA, first.within[A])
            + _attend_edges(own_A[3], own_B[4], own_B[5], e_AB, first.between)
            + self._recall(own_A[6], first.memory[A])
        )
        to_B = context.message_B + _attend_edges(q_B, own_A[4], own_A[5], e_BA, first.between)
        c = self.layers[0].class_update(c, h)
        h = (nn.functional.gelu(_join(to_A)), nn.functional.gelu(_join(to_B)))
        # The others.
        within, between = (e_AA, context.edges_B), (e_AB, e_BA)
        for layer, known in zip(self.layers[1:-1], context.layers[1:], strict=True):
            own = [project(features) for project, features in zip(known.asked, h, strict=True)]
            messages = [
                own[i][7]
                + _attend_edges(own[i][0], own[i][1], own[i][2], within[i], known.within[i])
                + _attend_edges(own[i][3], own[j][4], own[j][5], between[i], known.between)
                + self._recall(own[i][6], known.memory[i])
                for i, j in ((A, B), (B, A))
            ]
            c = layer.class_update(c, h)
            h = (nn.functional.gelu(_join(messages[A])), nn.functional.gelu(_join(messages[B])))
        c = self.layers[-1].class_update(c, h)
        for linear in self.mlp[:-1]:
            c = nn.functional.gelu(linear(c))
        return self.mlp[-1](c)
