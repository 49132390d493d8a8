"""From clouds to nodes: the parts around K centres, as the pre-trained local encoder sees them."""

from typing import NamedTuple

import torch
from torch import Tensor

from iga_drake.aligners.iga.local_encoder import LocalEncoder
from iga_drake.aligners.iga_paper.graph import A, B, Context, GraphNetwork, Nodes


class PaperProblem(NamedTuple):
    """Nodes of S problems, both objects of the test about their own centres."""

    demonstrations: tuple[Nodes, Nodes]  # of A and B, (S, N, K), in their common frames
    test: tuple[Nodes, Nodes]  # of A and B, (S, K)
    centres: tuple[Tensor, Tensor]  # (S, 3) m of the test's A and B: the means of their nodes

    def context(self, network: GraphNetwork) -> Context:
        """The network's features of the problems, independent of the candidate poses."""
        return network.context(self.demonstrations, self.test)

    def offset(self) -> Tensor:
        """(S, 3) m: from B's centre to A's in the demonstrations, on average."""
        p_A, p_B = (nodes.positions.mean(2) for nodes in self.demonstrations)
        return (p_A - p_B).mean(1)


@torch.no_grad()
def encode(encoder: LocalEncoder, clouds: Tensor, count: int) -> Nodes:
    """Nodes (..., K) of clouds (..., P, 3) m; K = `count` by furthest point sampling."""
    found = encoder(clouds.flatten(0, -3), count)
    lead = clouds.shape[:-2]
    return Nodes(found.centres.unflatten(0, lead), found.vectors.unflatten(0, lead))


def problem(alignments: Nodes) -> PaperProblem:
    """Problems from the nodes (S, 2, N + 1, K) of A and B in N + 1 alignments, the test's last."""
    shown = [Nodes(*(part[:, role, :-1] for part in alignments)) for role in (A, B)]
    asked = [Nodes(*(part[:, role, -1] for part in alignments)) for role in (A, B)]
    centres = [nodes.positions.mean(1) for nodes in asked]
    test = [
        Nodes(nodes.positions - centre[:, None], nodes.vectors)
        for nodes, centre in zip(asked, centres, strict=True)
    ]
    return PaperProblem((shown[A], shown[B]), (test[A], test[B]), (centres[A], centres[B]))
